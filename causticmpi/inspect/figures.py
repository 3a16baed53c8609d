"""The paper's Figure 1 (photon shooting) and Figure 2 (clusters by rank) for any scene."""

import colorsys

import numpy as np
from PIL import Image

from causticmpi.inspect.findings import Findings
from causticmpi.inspect.scenery import PAPER, Discs, Scenery, labelled, with_legend

MUSTARD, WHITE, BLACK, GREY = (225, 173, 1), (255, 255, 255), (0, 0, 0), (95, 95, 95)
SHOOTING_POINTS, CLUSTER_POINTS = 5_000, 50_000
"""Caustic points that are drawn, the first of all: more would hide the scene."""
RANKS = (0, 2, 4, 8)
"""As in Figure 2."""
GAP = 10
"""Pixels between the panels of Figure 2."""


def photon_shooting(found: Findings, scenery: Scenery) -> tuple[Image.Image, str]:
    """Figure 1: caustic points, indirect and direct virtual lights over the scene; and its caption."""
    direct = found.lights.material < 0
    points, lights = found.points, found.lights
    layers = [
        Discs(points.position[:SHOOTING_POINTS], points.normal[:SHOOTING_POINTS], 1.3, BLACK),
        Discs(lights.point[~direct], lights.normal[~direct], 2.6, WHITE, rim=0.9),
        Discs(lights.point[direct], lights.normal[direct], 2.6, MUSTARD, rim=0.9),
    ]
    picture, counts = scenery.drawn(scenery.bright(), layers)
    passes = f"{found.light_passes} passes" if found.light_passes > 1 else "a pass"
    told = [
        f"caustic points: {len(layers[0].places):,} of {len(points.position):,}",
        f"indirect virtual lights of {passes}: {len(layers[1].places):,}",
        f"direct virtual lights of {passes}: {len(layers[2].places):,}",
    ]
    if found.silence:
        told[0] = f"no caustic points: {found.silence}"
    shown = [
        (layer, f"{text}, {count:,} in sight") if len(layer.places) else (layer, text)
        for layer, text, count in zip(layers, told, counts, strict=True)
    ]
    picture = with_legend(picture, [(layer, text) for layer, text in reversed(shown)])
    caption = (
        f"Figure 1 for {found.scene.data.name}: photon shooting. Direct virtual lights are mustard, indirect ones "
        "white, caustic points black. Points behind glass or seen in mirrors alone are drawn where the eye sees them."
    )
    return picture, caption


def clusters_by_rank(found: Findings, scenery: Scenery) -> tuple[Image.Image, str]:
    """Figure 2: a panel for each of RANKS, the clusters up to it in colours, the others grey; and its caption."""
    assert found.statistics is not None and found.clusters is not None
    rank, energy = found.statistics.rank, found.statistics.energy
    places, normals = found.points.position[:CLUSTER_POINTS], found.points.normal[:CLUSTER_POINTS]
    cluster = found.clusters[:CLUSTER_POINTS]
    colours = cluster_colours(len(rank))
    panels = []
    for letter, highest in zip("abcd", RANKS, strict=True):
        kept = rank <= highest
        coloured = kept[cluster]
        layers = [
            Discs(places[~coloured], normals[~coloured], 1.0, GREY),
            Discs(places[coloured], normals[coloured], 1.3, colours[cluster[coloured]]),
        ]
        picture, _ = scenery.drawn(scenery.pale(), layers)
        share = 100 * float(energy[kept].sum())
        text = f"({letter}) rank {f'0 to {highest}' if highest else '0'}: {share:.2f} % of the caustic energy"
        more = f"{kept.sum()} of {len(rank)} clusters in colour; at least {100 * (1 - 0.5 ** (highest + 1)):.2f} %"
        panels.append(labelled(picture, [text, f"{more} by definition"]))
    width, height = panels[0].size
    sheet = Image.new("RGB", (2 * width + GAP, 2 * height), PAPER)
    for i, panel in enumerate(panels):
        sheet.paste(panel, (i % 2 * (width + GAP), i // 2 * height))
    caption = (
        f"Figure 2 for {found.scene.data.name}: {len(places):,} of {len(found.points.position):,} caustic points, a "
        "colour for each cluster; culled clusters are grey. The paper's fractions are 50, 87.5, 96.88 and 99.80 %."
    )
    return sheet, caption


def cluster_colours(count: int) -> np.ndarray:
    """(count, 3) uint8: saturated colours, neighbours in the list far apart."""
    # Steps of the golden ratio fill the circle of hues evenly for any count; lightness alternates on top.
    hues = np.arange(count) * 0.6180339887498949 % 1
    rows = [colorsys.hls_to_rgb(hue, (0.42, 0.56, 0.32)[i % 3], 0.95) for i, hue in enumerate(hues)]
    return (255 * np.array(rows).reshape(-1, 3)).astype(np.uint8)
