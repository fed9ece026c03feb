"""`asca doctor`: what runs here, and what to install for the rest."""

import platform

from rich.console import Console

from asca_deploy import Detector, default_bundle_path
from asca_deploy.providers import PROVIDERS, select_providers
from asca_pillars.commands.extras import EXTRAS, missing_modules
from asca_pillars.environment import package_versions
from asca_pillars.errors import AscaError
from asca_pillars.machine import cpu_model


def run() -> None:
    """See `asca doctor --help`."""
    console = Console(markup=False)
    console.print(f"Python {platform.python_version()}, {cpu_model()}")
    console.print(", ".join(f"{name} {version}" for name, version in package_versions().items()))
    for name in PROVIDERS:
        _check(console, f"provider {name}", lambda name=name: select_providers(name))
    for extra in EXTRAS:
        missing = missing_modules(extra)
        remedy = f"missing {', '.join(missing)}: pip install 'asca-pillars[{extra}]'"
        console.print(f"  extra {extra}: {remedy if missing else 'ok'}", highlight=False)
    _check(console, f"bundled model {default_bundle_path().name}", Detector)


def _check(console: Console, name: str, attempt: object) -> None:
    try:
        attempt()  # type: ignore[operator]
    except AscaError as error:
        console.print(f"  {name}: {error}", highlight=False)
    else:
        console.print(f"  {name}: ok", highlight=False)
