#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""The README's picture: methods side by side after the same wall-clock time, each with its estimated relMSE.

scripts/equal_time_picture.py docs/equal_time.png --time 60s -j 2 configs/ring.yaml configs/pool.yaml
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

METHODS = {"pt": "path tracing", "iws+cf": "IWS + Caustic Forecasting"}
BAR, SIDE = 34, 480


def rendered(config: str, method: str, arguments: argparse.Namespace, folder: Path) -> tuple[Image.Image, str]:
    """Run one method and return its picture and its caption."""
    out = folder / f"{Path(config).stem}-{method}"
    command = [sys.executable, "-m", "causticmpi", "render", config, "--method", method, "--out", str(out)]
    subprocess.run([*command, "--time", arguments.time, "-j", str(arguments.ranks)], check=True)
    report = json.loads((out / "report.json").read_text())
    error = report["estimated_relmse"]  # None for a single pass
    caption = f"{METHODS[method]}: {report['spp']:.0f} spp, relMSE {'unknown' if error is None else f'{error:.2g}'}"
    print(f"{config}: {caption}")
    image = Image.open(out / "image.png").convert("RGB")
    return image.resize((SIDE, SIDE * image.height // image.width)), caption


def pasted(rows: list[list[tuple[Image.Image, str]]]) -> Image.Image:
    """One picture of all, a row for each config and a column for each method, captions above."""
    heights = [BAR + row[0][0].height for row in rows]
    sheet = Image.new("RGB", (SIDE * len(METHODS), sum(heights)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=18)
    y = 0
    for row, height in zip(rows, heights, strict=True):
        for column, (image, caption) in enumerate(row):
            sheet.paste(image, (column * SIDE, y + BAR))
            draw.text((column * SIDE + 8, y + 6), caption, fill="black", font=font)
        y += height
    return sheet


def main() -> None:
    """Render every config with every method and paste the pictures into one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("configs", nargs="+")
    parser.add_argument("--time", default="60s")
    parser.add_argument("-j", dest="ranks", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            [rendered(config, method, arguments, Path(folder)) for method in METHODS] for config in arguments.configs
        ]
    pasted(rows).save(arguments.picture)


if __name__ == "__main__":
    main()
