"""What runs on this machine: the checks of `asca doctor`."""

import platform
from collections.abc import Callable
from functools import partial

from rich.console import Console

from asca_deploy import Detector, default_bundle_path, openvino_session
from asca_deploy.auto import summary
from asca_deploy.providers import AUTO, PROVIDERS, require
from asca_pillars.base.errors import AscaError
from asca_pillars.base.extras import EXTRAS, missing_modules
from asca_pillars.base.installation import install_command
from asca_pillars.base.system import cpu_model, package_versions


def print_checks(console: Console) -> None:
    """Print a line for each provider, extra and the bundled model."""
    console.print(f"Python {platform.python_version()}, {cpu_model()}")
    console.print(", ".join(f"{name} {version}" for name, version in package_versions().items()))
    for name in PROVIDERS:
        _check(console, f"provider {name}", partial(_provider, name))
    for extra in EXTRAS:
        missing = missing_modules(extra)
        remedy = f"missing {', '.join(missing)}: {install_command(extra)}"
        console.print(f"  extra {extra}: {remedy if missing else 'ok'}", highlight=False, soft_wrap=True)
    _check(console, f"bundled model {default_bundle_path().name}", _bundled_model)


def _provider(name: str) -> str:
    require(name)
    return f"ok, {openvino_session.describe()}" if name == "openvino" else "ok"


def _bundled_model() -> str:
    detector = Detector(provider=AUTO)
    return f"ok, {summary(detector.runs_on, detector.candidates)}"


def _check(console: Console, name: str, attempt: Callable[[], str]) -> None:
    try:
        found = attempt()
    except AscaError as error:
        found = str(error)
    console.print(f"  {name}: {found}", highlight=False, soft_wrap=True)
