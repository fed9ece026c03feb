"""Messages of errors."""

from asca_pillars.base.errors import printable


def test_nothing_in_a_message_reaches_the_terminal_as_a_control() -> None:
    assert printable("a\x1b[31mb\nc\x9b\u202e\udc80é") == r"a\x1b[31mb\nc\x9b\u202e\udc80é"


def test_long_messages_lose_their_middle() -> None:
    line = printable("bundle.json: " + "\x1b" * 1_000_000 + "; export it again")
    assert len(line) == 1000
    assert line.startswith("bundle.json: ") and line.endswith("; export it again")
    assert "left out" in line
    assert printable("x" * 1000) == "x" * 1000
