"""Random damage to the files of a run that is to be resumed: refused with one line, or the right bits; nothing else.

A case damages one file (or both checkpoints) of a small run that is half done and resumes it in this process. `Rig`
makes the run, `Rig.case` tries one damage, seeded by its number.
"""

import contextlib
import io
import random
import shutil
import signal
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from program_tools import main, read_layers, tree

HANGS = 30
"""Seconds after which a case counts as hung."""
CONFIG = """\
scene: scene.yaml
film: {width: 16, height: 12}
method: iws+cf      # the whole of it
iws: {paths: 2}
forecast: {photons: 300, clusters: 6, neighbours: 8}
budget: {spp: 4}
seed: 11
"""
SCENE = """\
# a closed room with a glass ball, a mirror and a small mesh
camera: {eye: [0, 0, 3.4], target: [0, 0, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: [0.7, 0.6, 0.5]}
  mirror: {type: mirror, reflectance: 0.9}
  glass: {type: dielectric, ior: 1.5}
shapes:
  - {type: box, min: [-2, -2, -2], max: [2, 2, 4], material: white}
  - {type: quad, corners: [[-0.4, 1.9, 0.4], [-0.4, 1.9, -0.4], [0.4, 1.9, -0.4], [0.4, 1.9, 0.4]], material: white,
     emission: [9, 8, 7]}
  - {type: sphere, center: [0.5, -0.4, 0.3], radius: 0.4, material: glass}
  - {type: mesh, file: binary.ply, material: mirror}
  - {type: mesh, file: text.ply, material: white, translate: [0.9, 0.2, -0.5]}
  - {type: mesh, file: plain.obj, material: white, translate: [-0.9, 0.4, 0]}
"""
TARGETS = ("checkpoint", "both checkpoints", "config.yaml", "scene.yaml", "binary.ply", "text.ply", "plain.obj")
CORNERS = np.array([[-1, -1, -1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]], np.float32) * np.float32(0.3)
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)


@dataclass(frozen=True)
class Outcome:
    """What became of one case. verdict: refused (unreadable); another (sound input, but of another run: refused as
    such, and rendered afresh a finite picture); recovered; the same (the damage means nothing); or wrong: ..."""

    target: str
    verdict: str
    lines: tuple[str, ...]
    seconds: float


class Rig:
    """A run of five passes whose checkpoints hold four and two, and the picture it should end with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.good, self.bad = folder / "good", folder / "bad"
        self.good.mkdir()
        for name, text in (("config.yaml", CONFIG), ("scene.yaml", SCENE), *meshes()):
            (self.good / name).write_bytes(text.encode() if isinstance(text, str) else text)
        for spp in ("2", "4"):
            self._render(self.good, spp)
        shutil.copytree(self.good, folder / "wanted")
        self._render(folder / "wanted", "5")
        self.wanted = self._picture(folder / "wanted")

    def case(self, number: int) -> Outcome:
        """Damage one target, resume, judge."""
        chance = random.Random(number)
        target = TARGETS[number % len(TARGETS)]
        shutil.rmtree(self.bad, ignore_errors=True)
        shutil.copytree(self.good, self.bad)
        names = ["out/checkpoint", "out/checkpoint.previous"] if target == "both checkpoints" else [target]
        for path in (self.bad / ("out/checkpoint" if name == "checkpoint" else name) for name in names):
            path.write_bytes(damaged(path.read_bytes(), chance))
        before = tree(self.bad)
        began = time.monotonic()
        try:
            with at_most(HANGS):
                code, lines = self._render(self.bad, "5")
        except BaseException as error:
            return Outcome(target, f"wrong: {type(error).__name__}: {traceback.format_exc()}", (), 0.0)
        return Outcome(target, self._verdict(code, lines, before), tuple(lines), time.monotonic() - began)

    def _verdict(self, code: int, lines: list[str], before: dict[str, bytes | None]) -> str:
        told = [line for line in lines if line.startswith("causticmpi: ")]
        if any("Traceback" in line for line in lines):
            return "wrong: a traceback"
        if code == 2:
            refusals = [line for line in told if "warning" not in line]
            if len(refusals) != 1 or tree(self.bad) != before:
                return "wrong: refused with other than one line, or with traces"
            return self._afresh() if "its checkpoint has" in refusals[0] else "refused"
        if code != 0:
            return f"wrong: exit code {code}"
        if self._picture(self.bad) != self.wanted:
            return "wrong: another picture"
        return "recovered" if any("truncated or altered" in line for line in told) else "the same"

    def _afresh(self) -> str:
        """Sound input: it can be rendered, as small as the other runs."""
        shutil.rmtree(self.bad / "out")
        small = [f"--set={key}" for key in ("film={width: 8, height: 6}", "forecast.photons=50", "iws.paths=1")]
        code, lines = self._render(self.bad, "1", *small)
        if code != 0:
            return f"wrong: sound, but ends with {code}: {lines}"
        layers, _ = read_layers(self.bad / "out")
        finite = all(np.isfinite(channel).all() for name, channel in layers.items() if name != "depth.Z")
        return "another" if finite else "wrong: a picture that is not finite"

    def _render(self, folder: Path, spp: str, *more: str) -> tuple[int, list[str]]:
        told = io.StringIO()
        words = ["render", str(folder / "config.yaml"), "--out", str(folder / "out"), "--spp", spp, "--resume", *more]
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(told):
            code = main(words)
        return code, told.getvalue().splitlines()

    def _picture(self, folder: Path) -> dict[str, bytes]:
        return {name: channel.tobytes() for name, channel in read_layers(folder / "out")[0].items()}


def meshes() -> Iterator[tuple[str, str | bytes]]:
    """A tetrahedron in three formats."""
    head = "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    rows = b"".join(bytes([3]) + face.astype("<i4").tobytes() for face in FACES)
    yield "binary.ply", head.format("binary_little_endian").encode() + CORNERS.astype("<f4").tobytes() + rows
    points = [" ".join(map(str, corner)) for corner in CORNERS]
    yield "text.ply", head.format("ascii") + "\n".join([*points, *(f"3 {a} {b} {c}" for a, b, c in FACES)]) + "\n"
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    yield "plain.obj", "\n".join([*(f"v {point}" for point in points), *faces]) + "\n"


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Something else than `content`, made of it."""
    while True:
        start, stop = sorted(chance.randrange(len(content) + 1) for _ in range(2))
        piece = content[start : min(stop, start + 64)]
        noise = chance.randbytes(chance.randint(1, 16))
        printable = bytes(
            chance.choice(b" 0123456789.-+eE:,[]{}#\n\"'abcxyz&*!|>%@") for _ in range(chance.randint(1, 4))
        )
        flipped = bytearray(content)
        for _ in range(chance.randint(1, 8)):
            flipped[chance.randrange(len(flipped))] ^= 1 << chance.randrange(8)
        found = chance.choice(
            (
                bytes(flipped),
                content[:start],
                content[:start] + content[stop:],
                content[:start] + noise + content[start:],
                content[:start] + noise + content[start + len(noise) :],
                content[:start] + printable + content[start + len(printable) :],
                content[:start] + printable + content[start:],
                content[:stop] + piece + content[stop:],
                content[:start] + bytes(len(piece)) + content[start + len(piece) :],
                content + noise,
                b"",
            )
        )
        if found != content:
            return found


@contextlib.contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after that time."""

    def over(number: int, frame: object) -> None:
        raise TimeoutError(f"hung for {seconds} s")

    previous = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
