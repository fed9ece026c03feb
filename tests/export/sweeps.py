"""The sensitivity sweep, most of the time of a quantization, cut short where it is not what is tested."""

from collections.abc import Callable, Mapping, Sequence

from asca_export.int8 import Sensitivity, sweep

Errors = Callable[[Sequence[str]], float]
Progress = Callable[[str], None]


def all_at_once(layers: Sequence[str], error_of: Errors, _: Progress) -> Sensitivity:
    """All layers in 8 bits, none of them tried in floating point."""
    return Sensitivity(dict.fromkeys(layers, 0.0), [], error_of(layers))


def remembered(alone: Mapping[str, float]) -> Callable[[Sequence[str], Errors, Progress], Sensitivity]:
    """The sweep itself, that knows the error of all layers but one from a sweep before."""

    def resumed(layers: Sequence[str], error_of: Errors, progress: Progress) -> Sensitivity:
        def error(eight_bit: Sequence[str]) -> float:
            left_out = [layer for layer in layers if layer not in eight_bit]
            return alone[left_out[0]] if len(left_out) == 1 else error_of(eight_bit)

        return sweep(layers, error, progress)

    return resumed
