"""Damaged files are refused or made good, never rendered wrongly; `scripts/fuzz.py` tries more of them."""

import pytest
from fuzzing import TARGETS, Rig

CASES = 70


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return Rig(tmp_path_factory.mktemp("fuzz"))


def test_damaged_files(rig: Rig) -> None:
    outcomes = [rig.case(number) for number in range(CASES)]
    wrong = [(number, o.target, o.verdict, o.lines) for number, o in enumerate(outcomes) if o.verdict[:5] == "wrong"]
    assert wrong == []
    for target in TARGETS[:2]:  # every damage of a checkpoint shows
        assert {o.verdict for o in outcomes if o.target == target} == {"recovered"}
    assert sum(o.verdict == "refused" for o in outcomes) > CASES / 4


def test_the_rig_knows_a_wrong_picture(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the checksum some damage goes through."""
    monkeypatch.setattr("causticmpi.output.checkpoint.hashlib.sha256", lambda *_: NoDigest())
    verdicts = {rig.case(number).verdict[:5] for number in range(0, 10 * len(TARGETS), len(TARGETS))}
    assert "wrong" in verdicts


class NoDigest:
    """In place of sha256: any content fits."""

    def digest(self) -> "AnyDigest":
        return AnyDigest()

    def update(self, part: bytes) -> None: ...


class AnyDigest(bytes):
    __hash__ = bytes.__hash__

    def __ne__(self, other: object) -> bool:
        return False
