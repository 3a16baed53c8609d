"""The scene that all renderers of a comparison get: ours, less what some of them do not know, in files of its own."""

import json
from pathlib import Path
from typing import Any

from causticmpi.config.load import load_config, scene_path
from causticmpi.config.yaml_source import read_yaml
from causticmpi.peers.export import Surface, icosphere, write_ply


def common_scene(config_file: Path, folder: Path, level: int | None) -> tuple[Path, str]:
    """Write config.yaml and scene.yaml into `folder`; returns the config and what differs from the original, if any.

    Gloss is replaced by its diffuse part, for ours too: no two renderers have the same lobe. level: spheres become
    icospheres of that level for all; None leaves them to those who know spheres. Raises InputError.
    """
    config = load_config(config_file)  # validates
    scene_file = scene_path(config_file, config)
    scene: dict[str, Any] = read_yaml(scene_file).data
    changes = []
    used = {shape["material"] for shape in scene["shapes"]}
    for name, material in scene["materials"].items():
        if material["type"] == "phong" and name in used:
            scene["materials"][name] = {"type": "diffuse", "reflectance": material.get("diffuse", 0)}
            changes.append(f"the gloss of `{name}` is left out, for all renderers alike")
    folder.mkdir(parents=True, exist_ok=True)
    for i, shape in enumerate(scene["shapes"]):
        if "file" in shape:
            shape["file"] = str((scene_file.parent / shape["file"]).resolve())
        if shape["type"] == "sphere" and level is not None:
            mesh = icosphere(shape.pop("center"), shape.pop("radius"), level)
            path = (folder / f"sphere{i}.ply").resolve()
            write_ply(Surface(f"sphere{i}", "", (), 1.0, None, *mesh), path)
            shape |= {"type": "mesh", "file": str(path)}
            changes.append(f"sphere {i} is a mesh of {len(mesh[1])} triangles for all renderers")
    ours = {**read_yaml(config_file).data, "scene": "scene.yaml"}
    for name, data in (("scene.yaml", scene), ("config.yaml", ours)):  # JSON is YAML too
        (folder / name).write_text(json.dumps(data, indent=1) + "\n")
    return folder / "config.yaml", "; ".join(changes)
