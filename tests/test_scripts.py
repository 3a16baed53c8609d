"""Everything in scripts/ starts by its name alone, in the clone's own environment."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from mpi_tools import ROOT

SCRIPTS = sorted(path for path in (ROOT / "scripts").iterdir() if path.is_file())


def first_line(script: Path) -> str:
    return script.read_text().partition("\n")[0]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_sets_up_what_it_needs(script: Path) -> None:
    assert os.access(script, os.X_OK)
    if script.suffix == ".py":
        assert "/setup_venv mpi" in first_line(script) and "python scripts/" not in script.read_text()
    else:
        assert first_line(script) == "#!/bin/sh" and "setup_venv" in script.read_text()


def test_a_python_script_starts_in_the_clone_it_lies_in(tmp_path: Path) -> None:
    """With the words it was given, from any directory; and not at all where the set-up fails."""
    line = first_line(ROOT / "scripts" / "faults.py")
    folder = tmp_path / "a clone" / "scripts"
    (folder.parent / ".venv" / "bin").mkdir(parents=True)
    (folder.parent / ".venv" / "bin" / "python").symlink_to(sys.executable)
    folder.mkdir()
    script, setup = folder / "probe.py", folder / "setup_venv"
    script.write_text(f"{line}\nimport sys\nprint(sys.argv[1:], sys.executable)\n")
    setup.write_text('#!/bin/sh\necho "extras: $*" >&2\nexit $FAIL\n')
    for path in (script, setup):
        path.chmod(0o755)
    env = {"PATH": os.environ["PATH"], "FAIL": "0"}
    for command, here in (("./scripts/probe.py", folder.parent), (str(script), tmp_path)):
        done = subprocess.run([command, "-j", "a  b", "$x"], cwd=here, env=env, capture_output=True, text=True)
        assert done.stdout.startswith("['-j', 'a  b', '$x'] ") and "a clone/" in done.stdout, done.stderr
        assert done.stderr == "extras: mpi,test\n"
    done = subprocess.run([script], env=env | {"FAIL": "3"}, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (3, "")
