"""What pipelines keep from scan to scan, between threads."""

from typing import Any

from asca_deploy.pipeline import take_free


class TakenMeanwhile(list[Any]):
    """Its last entry is taken by another thread after one has looked and before one takes."""

    def __len__(self) -> int:
        return 1

    def __bool__(self) -> bool:
        return True


def test_what_is_free_is_used_again() -> None:
    free = ["kept"]
    assert (take_free(free, lambda: "made"), take_free(free, lambda: "made")) == ("kept", "made")


def test_another_thread_may_take_the_last_one() -> None:
    assert take_free(TakenMeanwhile(), lambda: "made") == "made"
