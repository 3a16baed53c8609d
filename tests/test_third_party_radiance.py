"""Absolute radiance: another renderer's picture of the same triangles, spheres and light (third_party.py)."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi_tools import python_environment
from third_party import block_means, configured, difference, kept, p_values, render_ours, scene_of

RENDERS = {("cornell", "pt"): 8192, ("cornell", "iws+cf"): 1024, ("ring", "pt"): 8192, ("ring", "iws+cf"): 1024}
"""Samples per pixel."""
SIGNIFICANCE = 0.01
"""Of all the t-tests of this file together (Sidak)."""
TOLERANCE = 0.005
"""Of the whole picture's mean, where our own standard error is below half of it; path tracing's on the ring is not."""


def agree(found: np.ndarray, wanted: np.ndarray) -> bool:
    """No block and channel differs significantly; batches (n, blocks, 3)."""
    tests = len(RENDERS) * found[0].size
    return float(p_values(found, wanted).min()) > 1 - (1 - SIGNIFICANCE) ** (1 / tests)


@pytest.mark.parametrize("name", ["cornell", "ring"])
def test_it_is_the_same_scene(name: str) -> None:
    assert kept(name)["scene_hash"] == scene_of(name).content_hash, "render anew: python tests/third_party.py --write"
    assert "Mitsuba" in kept(name)["renderer"]


@pytest.mark.statistical
@pytest.mark.parametrize(("name", "method"), list(RENDERS))
def test_radiance_is_the_third_partys(name: str, method: str) -> None:
    theirs = kept(name)
    pictures = render_ours(name, configured(method), RENDERS[name, method])
    ours = block_means(pictures, theirs["left_out"])
    assert agree(ours, theirs["blocks"])
    ratio, error = (values[-1] for values in difference(ours, theirs["blocks"]))
    if (name, method) != ("ring", "pt"):
        assert error < TOLERANCE / 2
        assert abs(ratio) < TOLERANCE, f"{100 * ratio:+.2f} %"
        assert not agree(1.02 * ours, theirs["blocks"])  # it would be found


def test_the_third_party_still_says_so(tmp_path: Path) -> None:
    """Render anew where the other renderer is installed: pip install '.[peers]' in the clone."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (pip install '.[peers]' in the clone)")
    program = Path(__file__).with_name("third_party.py")
    done = subprocess.run(
        [sys.executable, str(program), "--samples", "4096", "--seed", "2"],
        env=python_environment(),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2, done.stdout
    for line in lines:
        p = float(line.partition("p = ")[2].split()[0])
        assert p > SIGNIFICANCE, line
