"""What runs on this machine, and what to install for the rest: what `asca doctor` prints."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from asca_deploy import openvino_session
from asca_deploy.auto import summary
from asca_deploy.detector import Detector
from asca_deploy.providers import AUTO, PROVIDERS, require
from asca_deploy.shipped import default_bundle_path
from asca_pillars.base.errors import AscaError
from asca_pillars.base.extras import EXTRAS, missing_modules
from asca_pillars.base.installation import install_command
from asca_pillars.base.system import cpu_model, package_versions


@dataclass(frozen=True)
class Check:
    """One thing that was tried: `text` says how it went, or how to make it work."""

    name: str
    ok: bool
    text: str


@dataclass(frozen=True)
class Examination:
    """A machine: Python and processor, versions of packages, and the checks of providers, extras and the model."""

    machine: str
    versions: dict[str, str]
    checks: tuple[Check, ...]


def examine() -> Examination:
    """Try every provider, look for every extra, and run the default model."""
    checks = [_check(f"provider {name}", partial(_provider, name)) for name in PROVIDERS]
    for extra in EXTRAS:
        missing = missing_modules(extra)
        remedy = f"missing {', '.join(missing)}: {install_command(extra)}"
        checks.append(Check(f"extra {extra}", not missing, remedy if missing else "ok"))
    checks.append(_check(f"bundled model {default_bundle_path().name}", _bundled_model))
    machine = f"Python {platform.python_version()}, {cpu_model()}"
    return Examination(machine, package_versions(), tuple(checks))


def _provider(name: str) -> str:
    require(name)
    return f"ok, {openvino_session.describe()}" if name == "openvino" else "ok"


def _bundled_model() -> str:
    detector = Detector(provider=AUTO)
    return f"ok, {summary(detector.runs_on, detector.candidates)}"


def _check(name: str, attempt: Callable[[], str]) -> Check:
    try:
        return Check(name, True, attempt())
    except AscaError as error:
        return Check(name, False, str(error))
