"""The quick picture that points are drawn over, and the discs, labels and legends drawn on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from causticmpi.inspect.findings import Findings
from causticmpi.inspect.sight import Sight
from causticmpi.kernels.pixels import pixel_order
from causticmpi.output.png import srgb_bytes
from causticmpi.render.methods import make_method
from causticmpi.scene.tracing import camera_array

PASSES = 8
"""Passes of the quick picture."""
LEAST_WIDTH = 480
"""Narrower films are drawn enlarged, that the labels find room."""
FINE = 4
"""Discs are drawn so many times larger, then averaged: round at any size."""
INK, PAPER = (30, 30, 30), (255, 255, 255)
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Discs:
    """Points of one kind: places (n, 3) [scene units], normals (n, 3) on the side they lie on, radius and rim in
    pixels, a colour for all or one for each."""

    places: np.ndarray
    normals: np.ndarray
    radius: float
    colour: Colour | np.ndarray
    rim: float = 0.0


class Scenery:
    """A quick picture of the scene through the config's window, and where its eye sees points."""

    def __init__(self, found: Findings) -> None:
        config, scene = found.config, found.scene
        film = config.film
        window = film.window
        camera = camera_array(scene.data.camera, film.width, film.height)
        self.sight = Sight(scene.traced, camera, window, film.width)
        self.zoom = -(-LEAST_WIDTH // self.sight.width)
        method = make_method(config, scene.traced, camera, found.forecasting.maps, scene.extent)
        pixels = pixel_order(window, film.width)
        sums = np.zeros((self.sight.width * self.sight.height, 6), np.float32)
        for index in range(PASSES):
            method.begin_pass(index)
            method.trace(pixels, sums)
        radiance = (sums[:, :3].astype(np.float64) + sums[:, 3:]) / PASSES
        noisy = Image.fromarray(srgb_bytes(radiance.reshape(self.sight.height, self.sight.width, 3)))
        self.quick = noisy.filter(ImageFilter.MedianFilter(3))  # a few samples' speckle would pass for points

    def bright(self) -> Image.Image:
        """The quick picture, its shadows lifted so that black points show."""
        return self._enlarged(Image.eval(self.quick, lambda byte: 80 + 175 * byte // 255))

    def pale(self) -> Image.Image:
        """The quick picture in light greys, that colours stand out."""
        return self._enlarged(Image.eval(self.quick.convert("L"), lambda byte: 105 + 140 * byte // 255).convert("RGB"))

    def _enlarged(self, picture: Image.Image) -> Image.Image:
        return picture.resize((self.zoom * picture.width, self.zoom * picture.height), Image.Resampling.BICUBIC)

    def drawn(self, backdrop: Image.Image, layers: Sequence[Discs]) -> tuple[Image.Image, list[int]]:
        """The backdrop with the discs, later layers over earlier ones, and how many of each layer the eye sees."""
        counts = []
        for layer in layers:
            spots, seen = self.sight.spots(layer.places, layer.normals)
            colours = np.broadcast_to(np.asarray(layer.colour, np.uint8), (len(seen), 3))[seen]
            backdrop = _with_discs(backdrop, self.zoom * spots[seen], layer.radius, layer.rim, colours)
            counts.append(int(seen.sum()))
        return backdrop, counts


def _with_discs(picture: Image.Image, spots: np.ndarray, radius: float, rim: float, colours: np.ndarray) -> Image.Image:
    # Transparent pixels carry no colour of their own that averaging could smear into the edges: premultiplied alpha.
    sheet = Image.new("RGBa", (FINE * picture.width, FINE * picture.height))
    draw = ImageDraw.Draw(sheet)
    for (x, y), colour in zip((FINE * spots).tolist(), colours.tolist(), strict=True):
        if rim:
            draw.circle((x, y), FINE * (radius + rim), fill=(*INK, 255))
        draw.circle((x, y), FINE * radius, fill=(*colour, 255))
    return Image.alpha_composite(picture.convert("RGBA"), sheet.reduce(FINE).convert("RGBA")).convert("RGB")


def font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font that comes with Pillow."""
    return ImageFont.load_default(size)


def labelled(picture: Image.Image, lines: Sequence[str], size: float = 15) -> Image.Image:
    """The picture with lines of text below it, the first one larger."""
    row = int(1.5 * size)
    canvas = Image.new("RGB", (picture.width, picture.height + row * len(lines) + row // 2), PAPER)
    canvas.paste(picture)
    draw = ImageDraw.Draw(canvas)
    for i, line in enumerate(lines):
        draw.text((6, picture.height + row * i + row // 3), line, INK, font(size if i == 0 else 0.87 * size))
    return canvas


def with_legend(picture: Image.Image, entries: Sequence[tuple[Discs, str]], size: float = 15) -> Image.Image:
    """The picture with one row for each kind of disc below it."""
    row = int(1.6 * size)
    canvas = Image.new("RGB", (picture.width, picture.height + row * len(entries) + row // 2), PAPER)
    canvas.paste(picture)
    draw = ImageDraw.Draw(canvas)
    for i, (discs, text) in enumerate(entries):
        y = picture.height + row * (i + 0.5) + row // 4
        colour = np.asarray(discs.colour, np.uint8)[None]
        canvas = _with_discs(canvas, np.array([[16.0, y]]), discs.radius, discs.rim, colour)
        draw = ImageDraw.Draw(canvas)
        draw.text((32, y), text, INK, font(size), anchor="lm")
    return canvas
