"""Side views of the body styles of cars and vans."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Profile:
    """Side view of a body style, as shares of length (from the nose) and of height.

    Attributes:
        top: (x, z) of the outline from nose to tail.
        glass: spans of x between which the top outline is a pane (windscreen, rear window).
        cabin: span of x that has side windows.
        belt: height of the belt line.
        tumble: half width of the roof over half width of the body.
    """

    top: tuple[tuple[float, float], ...]
    glass: tuple[tuple[float, float], ...]
    cabin: tuple[float, float]
    belt: float = 0.63
    tumble: float = 0.76


def outline(x: tuple[float, ...], z: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """Points from nose to tail: shares of length, shares of height."""
    return tuple(zip(x, z, strict=True))


# Roofs rise from the windscreen to about the driver's back and fall again: that slope is what rings of a sensor
# hardly higher than the roof meet.
CITY = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.12, 0.23, 0.35, 0.45, 0.51, 0.58, 0.78, 0.9, 0.972, 0.99, 1.0),
        (0.32, 0.46, 0.55, 0.6, 0.67, 0.81, 0.92, 0.97, 1.0, 0.985, 0.935, 0.66, 0.6, 0.34),
    ),
    glass=((0.23, 0.45), (0.9, 0.972)),
    cabin=(0.28, 0.84),
    belt=0.64,
    tumble=0.78,
)
HATCHBACK = Profile(
    outline(
        (0.0, 0.02, 0.07, 0.15, 0.31, 0.39, 0.48, 0.54, 0.61, 0.7, 0.84, 0.9, 0.965, 0.99, 1.0),
        (0.34, 0.47, 0.55, 0.6, 0.66, 0.79, 0.91, 0.965, 0.995, 1.0, 0.965, 0.925, 0.69, 0.62, 0.36),
    ),
    glass=((0.31, 0.48), (0.9, 0.965)),
    cabin=(0.35, 0.83),
)
SALOON = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.29, 0.365, 0.45, 0.51, 0.57, 0.62, 0.72, 0.84, 0.93, 0.975, 0.985, 1.0),
        (0.34, 0.47, 0.55, 0.61, 0.67, 0.79, 0.9, 0.965, 0.995, 1.0, 0.955, 0.75, 0.73, 0.69, 0.56, 0.36),
    ),
    glass=((0.29, 0.45), (0.72, 0.84)),
    cabin=(0.33, 0.75),
)
ESTATE = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.28, 0.36, 0.45, 0.51, 0.58, 0.66, 0.86, 0.92, 0.97, 0.985, 1.0),
        (0.34, 0.47, 0.55, 0.61, 0.67, 0.79, 0.91, 0.965, 0.995, 1.0, 0.97, 0.93, 0.66, 0.6, 0.36),
    ),
    glass=((0.28, 0.45), (0.92, 0.97)),
    cabin=(0.32, 0.89),
)
SUV = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.14, 0.29, 0.365, 0.45, 0.51, 0.59, 0.84, 0.9, 0.965, 0.99, 1.0),
        (0.4, 0.52, 0.6, 0.645, 0.69, 0.82, 0.93, 0.975, 1.0, 0.98, 0.945, 0.69, 0.62, 0.4),
    ),
    glass=((0.29, 0.45), (0.9, 0.965)),
    cabin=(0.33, 0.85),
    belt=0.66,
    tumble=0.8,
)
MINIVAN = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.15, 0.22, 0.32, 0.42, 0.49, 0.57, 0.85, 0.93, 0.975, 0.99, 1.0),
        (0.3, 0.42, 0.5, 0.57, 0.62, 0.8, 0.92, 0.975, 1.0, 0.985, 0.95, 0.6, 0.5, 0.3),
    ),
    glass=((0.22, 0.42), (0.93, 0.975)),
    cabin=(0.26, 0.89),
    belt=0.59,
    tumble=0.84,
)
PICKUP = Profile(
    outline(
        (0.0, 0.02, 0.05, 0.24, 0.35, 0.42, 0.56, 0.6, 0.98, 0.99, 1.0),
        (0.36, 0.54, 0.6, 0.65, 0.96, 1.0, 0.98, 0.62, 0.6, 0.56, 0.36),
    ),
    glass=((0.24, 0.35), (0.56, 0.6)),
    cabin=(0.28, 0.58),
    belt=0.62,
    tumble=0.82,
)
CONVERTIBLE = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.15, 0.32, 0.38, 0.43, 0.45, 0.46, 0.8, 0.95, 0.985, 1.0),
        (0.38, 0.52, 0.61, 0.67, 0.74, 0.88, 0.98, 1.0, 0.77, 0.77, 0.74, 0.62, 0.4),
    ),
    glass=((0.32, 0.43),),
    cabin=(0.33, 0.34),
    belt=0.7,
    tumble=0.8,
)
VAN = Profile(
    outline(
        (0.0, 0.015, 0.04, 0.16, 0.23, 0.29, 0.35, 0.45, 0.97, 0.99, 0.995, 1.0),
        (0.24, 0.36, 0.44, 0.52, 0.74, 0.92, 0.985, 1.0, 0.99, 0.8, 0.4, 0.24),
    ),
    glass=((0.16, 0.29),),
    cabin=(0.18, 0.36),
    belt=0.52,
    tumble=0.9,
)
# A small delivery van: a car's nose, a tall closed back.
BOX_VAN = Profile(
    outline(
        (0.0, 0.02, 0.06, 0.22, 0.31, 0.38, 0.43, 0.55, 0.96, 0.985, 0.99, 1.0),
        (0.28, 0.42, 0.48, 0.56, 0.76, 0.9, 0.97, 1.0, 0.985, 0.8, 0.4, 0.28),
    ),
    glass=((0.22, 0.38),),
    cabin=(0.26, 0.5),
    belt=0.56,
    tumble=0.88,
)
