"""Random quantities of the simulator and their bounds. A config file may change every number here."""

from dataclasses import dataclass, fields

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict


@dataclass(frozen=True)
class SceneConfig(Strict):
    """Ranges of the random streets. Pairs are bounds of a uniform distribution unless stated otherwise; m and rad.

    The class rates are mean numbers of objects placed ahead of the car, within `reach_m`; as many are placed behind it.
    Some are outside the camera's view or occluded: about 65 % are labelled. KITTI's labels have 3.8 cars,
    0.6 pedestrians and 0.2 cyclists per frame; the defaults give more people, who are rare in training data.
    """

    cars: float = 7.6
    pedestrians: float = 2.7
    cyclists: float = 1.7
    vans: float = 0.55
    trucks: float = 0.22
    trams: float = 0.05
    misc: float = 0.18
    sitting: float = 0.10
    beyond: float = 1.2  # cars beyond the sensor's range, which become DontCare
    # Dispersion of the negative binomial counts: the smaller, the more often none or many. People come in crowds.
    dispersion: float = 2.1
    people_dispersion: float = 0.7
    empty_share: float = 0.12  # scenes without any labelled type
    reach_m: float = 79.0

    alongside: float = 0.05  # fraction of objects beside the car, up to 7 m before or behind it
    # Fractions of vehicles by position: parked, by the kind of street; of the others: in yards and drives,
    # on the crossing road; the rest is driving.
    parked_residential: float = 0.64
    parked_urban: float = 0.44
    parked_rural: float = 0.14
    parked_campus: float = 0.47
    off_street: float = 0.18
    on_crossing_road: float = 0.12
    # At some distance to the side, occluded by a shrub, a post or another car, as real cars mostly are there.
    half_hidden: float = 0.14
    half_hidden_ahead_m: tuple[float, float] = (16.0, 45.0)
    half_hidden_aside_m: tuple[float, float] = (7.0, 20.0)
    next_to_parked: float = 0.65
    nose_in: float = 0.15
    parked_against_traffic: float = 0.20
    in_queue: float = 0.30
    oncoming: float = 0.45

    pedestrian_uniform_heading: float = 0.45
    # Fraction of the others who cross the sensor's line of sight at a right angle, give or take 20 degrees; the rest
    # walks along the street.
    pedestrian_across_sight: float = 0.55
    in_company: float = 0.42
    side_by_side: float = 0.6  # of those in company; the others walk behind or meet
    side_by_side_m: tuple[float, float] = (0.45, 0.80)
    zebra_at_junction: float = 0.6
    on_zebra: float = 0.10
    walking_in_road: float = 0.10
    beyond_pavement: float = 0.25  # of those beside the road, up to 8 m beyond
    cyclist_crossing: float = 0.45  # the street, which is mostly across the line of sight
    riding_together: float = 0.20
    riding_against_traffic: float = 0.30
    # Height of a label box's bottom above the ground, mean and standard deviation: of people and riders, of vehicles.
    box_lift_m: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.03), (0.012, 0.05))
    # Objects are on streets and beside them, not on slopes: at most so far from the level of the car's street,
    # metres, plus metres per metre of distance. KITTI's labels deviate by 0.15, 0.22, 0.33 m at 15, 25, 35 m.
    level_band_m: tuple[float, float] = (0.17, 0.02)
    # Standard deviation of a body's center about that of its label box.
    box_offset_sigma_m: float = 0.03
    # Distance of a person's body behind the center of its label, seen from the sensor, mean and standard deviation.
    person_behind_box_m: tuple[float, float] = (0.11, 0.03)

    warp_m: tuple[float, float] = (0.02, 0.06)  # largest displacement of a body's points by a smooth field
    dark_patch_share: float = 0.15  # of bodies with a part without returns

    # Fractions of street kinds: narrow with parked cars, wide in town, out of town, square or campus, trunk road,
    # alley between walls.
    residential: float = 0.32
    urban: float = 0.28
    rural: float = 0.12
    campus: float = 0.11
    road: float = 0.12
    alley: float = 0.05
    junction_share: float = 0.45
    rails_share: float = 0.10
    median_share: float = 0.4  # of the wide streets
    closed_end_share: float = 0.14  # streets that end before a wood or a house, on either end
    turning_share: float = 0.12  # the car is at up to half a radian to the street

    sensor_height_m: tuple[float, float] = (1.69, 1.82)
    heading_error_sigma_rad: float = 0.035  # of the car in its lane
    bend_sigma_per_m: float = 0.0022  # curvature of the road
    # Mean and standard deviation of the slopes under the car, as in KITTI's scans.
    slope_x: tuple[float, float] = (0.0105, 0.0035)
    slope_y: tuple[float, float] = (-0.009, 0.016)
    relief_m: tuple[float, float] = (0.1, 2.6)
    bump_m: tuple[float, float] = (0.0, 0.15)  # standard deviation of bumps beyond the pavement
    bank_slope_sigma: float = 0.065  # of the ground beyond the pavement
    embankment_slope: tuple[float, float] = (-0.25, 0.42)
    ditch_m: tuple[float, float] = (0.1, 0.6)
    grass_m: tuple[float, float] = (0.02, 0.16)

    clutter: tuple[float, float] = (15.0, 60.0)  # posts, signs, bins, shrubs and the like per 100 m of street
    far_clutter: float = 30.0  # mean number of low and sparse objects farther than 28 m, ahead and behind
    distractor_share: float = 0.0  # fraction of clutter that random compositions as large as a person replace
    behind_gaps: float = 0.4  # fraction of vehicles with a narrow object behind their ends
    thick_trunks: float = 0.45  # fraction of trees with a trunk of 0.35 to 0.6 m that widens towards its roots
    crown_density_per_m: tuple[float, float] = (0.15, 1.8)
    dark_paint_share: float = 0.25

    # An object with fewer returns in the image is marked DontCare, a hardly visible one too.
    min_points: int = 2
    min_visible_share: float = 0.05

    def __post_init__(self) -> None:
        normal = ("slope_x", "slope_y", "level_band_m", "person_behind_box_m")  # not bounds of a uniform distribution
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "box_lift_m":
                if min(deviation for _, deviation in value) < 0:
                    raise ConfigError(f"{item.name} is {value}: deviations must not be negative")
            elif isinstance(value, tuple):
                if item.name not in normal and value[0] > value[1]:
                    raise ConfigError(f"{item.name} is {value}: the lower bound comes first")
                if value[1 if item.name in normal else 0] < 0 and item.name != "embankment_slope":
                    what = "the second number" if item.name in normal else "the lower bound"
                    raise ConfigError(f"{item.name} is {value}: {what} must not be negative")
            elif value < 0:
                raise ConfigError(f"{item.name} is {value}: it must not be negative")
        if self.sensor_height_m[0] <= 0:
            raise ConfigError(f"sensor_height_m is {self.sensor_height_m}: the sensor is above the ground")
        if self.reach_m <= 2:
            raise ConfigError(f"reach_m is {self.reach_m}: objects stand beyond 2 m")
        if self.people_dispersion <= 0:
            raise ConfigError(f"people_dispersion is {self.people_dispersion}: it must be positive")
        kinds = self.residential + self.urban + self.rural + self.campus + self.road + self.alley
        if kinds <= 0 or self.dispersion <= 0:
            raise ConfigError("the shares of the kinds of streets must not all be 0, nor the dispersion")
