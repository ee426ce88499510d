"""The support of an estimate: never a single frame, and no leap that the wheels can't explain."""

import pytest

from jaxnav.drive.chassis import Motion, chassis_of
from jaxnav.drive.support import CONFIRMED, SLOW_M, Support
from jaxnav.drive.ways import Fix
from tests import worlds

HERE = Fix(0.0, 0.0, 0.0, 0.005, 0.005)
AWAY = Fix(1.0, 0.0, 0.0, 0.005, 0.005)


class Seeing:
    """Frames at 30 Hz."""

    def __init__(self, **how):
        self.chassis = chassis_of(worlds.qcar())
        self.support = Support(self.chassis, **how)
        self.now_ns = 10**9

    def frames(self, count, fix=HERE, believed=True, possible=(), agrees=True) -> list[bool]:
        taken = []
        for _ in range(count):
            self.now_ns += 33_000_000
            told = believed, believed and agrees, self.now_ns, fix
            taken.append(self.support.add_corners(*told, lambda: possible))
        return taken

    @classmethod
    def restarted(cls, **how):
        """After a restart of the filter, once the place was confirmed."""
        seeing = cls(**how)
        seeing.frames(10)
        seeing.support.note_restart()
        return seeing

    def drives(self, way_m: float) -> None:
        for _ in range(50):
            wanted_mps = self.chassis.wanted_mps((0.0, way_m / 10))
            told = (way_m,), Motion(way_m, 0.0, 0.0), 0.0, 0.02, wanted_mps, True
            self.support.add_odometry(*told)


def test_no_single_frame_confirms():
    seeing = Seeing()
    for _ in range(100):  # nor frames that contradict each other
        assert not any(seeing.frames(CONFIRMED - 1))
        seeing.frames(1, believed=False)
        assert seeing.support.doubt_m(contradicted=False) is not None
    assert seeing.frames(CONFIRMED) == [False] * (CONFIRMED - 1) + [True]
    assert seeing.support.doubt_m(contradicted=False) is None


def test_one_contradiction_takes_nothing_away_and_many_do():
    seeing = Seeing()
    seeing.frames(10)
    seeing.frames(1, believed=False)
    assert seeing.frames(1) == [True]
    assert seeing.support.doubt_m(contradicted=False) is None
    assert seeing.support.doubt_m(contradicted=True) is not None


def test_what_the_filter_accepts_beyond_its_gate_is_a_fix_and_confirms_nothing():
    """A car that is being located is not stopped for want of a fix; nor does it start on that."""
    seeing = Seeing()
    assert not any(seeing.frames(20, agrees=False))
    assert seeing.support.doubt_m(contradicted=False) is not None
    seeing.frames(CONFIRMED)
    assert seeing.frames(20, agrees=False) == [True] * 20
    seeing.support.note_restart()
    assert not any(seeing.frames(CONFIRMED - 1))
    assert not any(seeing.frames(1, agrees=False))
    assert not any(seeing.frames(CONFIRMED - 1))


def test_a_relocation_is_slow_until_some_way_was_driven_and_a_restart_nearby_is_none():
    seeing = Seeing.restarted()
    assert seeing.frames(CONFIRMED, AWAY)[-1]
    assert (seeing.support.relocated, seeing.support.relocations) == (True, 1)
    assert not seeing.support.refused
    seeing.drives(0.9 * SLOW_M)
    assert seeing.support.relocated
    seeing.drives(0.2 * SLOW_M)
    assert not seeing.support.relocated
    nearby = Seeing.restarted()
    assert nearby.frames(CONFIRMED, Fix(0.05, 0.05, 0.1, 0.01, 0.01))[-1]
    assert not nearby.support.relocated


def test_every_further_relocation_asks_for_twice_as_many_frames():
    seeing, needed, at = Seeing(), [], [AWAY, HERE]
    seeing.frames(10)
    for lap in range(9):
        seeing.support.note_restart()
        needed.append(seeing.frames(200, at[lap % 2]).index(True) + 1)
    assert needed == [2, 4, 8, 16, 32, 64, 96, 96, 96]
    seeing.drives(1.1 * SLOW_M)
    seeing.support.note_restart()
    assert seeing.frames(10).index(True) + 1 == CONFIRMED


def test_who_must_not_relocate_refuses_and_goes_on_where_it_was():
    seeing = Seeing.restarted(relocate=False)
    assert not any(seeing.frames(30, AWAY))
    assert seeing.support.refused
    assert seeing.support.relocated
    assert seeing.support.doubt_m(contradicted=False) is not None
    assert seeing.frames(1, HERE) == [True]
    assert not seeing.support.refused
    assert not seeing.support.relocated


@pytest.mark.parametrize(("possible", "refused"), [([AWAY, HERE], False), ([AWAY, AWAY], True)])
def test_while_several_poses_are_possible_one_within_reach_suffices(possible, refused):
    seeing = Seeing.restarted(relocate=False)
    taken = seeing.frames(5, None, possible=possible)
    assert seeing.support.refused == refused
    assert taken[-1] != refused


def test_a_loop_that_was_away_knows_of_no_way():
    seeing = Seeing(relocate=False)
    seeing.frames(10)
    seeing.support.begin_anew()
    assert seeing.frames(CONFIRMED, AWAY)[-1]
    assert not seeing.support.relocated
