"""How a simulation is divided."""

from asca_pillars.sim.parallel import held_out


def test_both_lists_get_a_frame_where_there_are_two() -> None:
    assert [held_out(count, 0.1) for count in (1, 2, 5, 14, 100)] == [0, 1, 1, 1, 10]
    assert [held_out(3, share) for share in (0.0, 0.9, 1.0)] == [0, 2, 3]
