"""Statistics of the training scans, stored in the bundle for `input_check`."""

from dataclasses import dataclass

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict

_HIGHEST_M = 100.0  # larger heights of the ground are not plausible


@dataclass(frozen=True)
class ExpectedInput(Strict):
    """Statistics of the training scans: (lowest, highest) over scans."""

    points_per_scan: tuple[int, int]
    """Finite points of a scan, cropped to the camera's view if `camera_view`."""
    reflectance_mean: tuple[float, float]
    """Mean reflectance of a scan, 0..1."""
    ground_z_m: tuple[float, float] | None
    """Height of the ground near the sensor, LiDAR frame, metres (minus the sensor's height); None if no scan
    showed the ground."""
    camera_view: bool
    """True if the scans were cropped to the points in the camera's image."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("points_per_scan", 0, 2**53),
            ("reflectance_mean", 0, 1),
            ("ground_z_m", -_HIGHEST_M, _HIGHEST_M),
        ):
            ends = getattr(self, name)
            if ends is not None and not low <= ends[0] <= ends[1] <= high:
                raise ConfigError(
                    f"expected_input.{name} = {list(ends)}: must be lowest and highest in {low:g}..{high:g}"
                )

    @property
    def sensor_height_m(self) -> float | None:
        """Height of the sensor above the ground in the middle of those scans; None where no scan showed it."""
        return None if self.ground_z_m is None else -sum(self.ground_z_m) / 2
