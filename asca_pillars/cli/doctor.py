"""`asca doctor`: capabilities of this machine, and how to install missing parts."""

import platform
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asca_pillars.base.errors import AscaError
from asca_pillars.base.installation import EXTRAS, install_command, missing_modules
from asca_pillars.base.system import cpu_model, own_version, package_versions

if TYPE_CHECKING:
    from rich.console import Console


def doctor(
    *, json: Annotated[bool, typer.Option("--json", help="Print everything as JSON instead, for programs.")] = False
) -> None:
    """Say what is installed, what can run here, and what to install for the rest.

    The exit code is 1 if the bundled model does not run here.
    """
    import json as json_module

    from rich.console import Console

    checks = check_machine()
    if json:
        print(json_module.dumps(checks, indent=1))
    else:
        print_checks(checks, Console(markup=False))
    if not checks["model"]["ok"]:
        raise typer.Exit(1)


def check_machine() -> dict[str, Any]:
    """Return versions and, for each provider, extra and the bundled model, if it runs ("ok") and details ("says")."""
    from asca_deploy import default_bundle_path
    from asca_deploy.providers import PROVIDERS

    return {
        "version": own_version(),
        "python": platform.python_version(),
        "cpu": cpu_model(),
        "packages": package_versions(),
        "providers": {name: _check(partial(_provider, name)) for name in PROVIDERS},
        "extras": {extra: _extra(extra) for extra in EXTRAS},
        "model": {"name": default_bundle_path().name} | _check(_bundled_model),
    }


def print_checks(checks: dict[str, Any], console: "Console") -> None:
    """Print a line for each provider, extra and the bundled model."""
    console.print(f"Python {checks['python']}, {checks['cpu']}")
    console.print(", ".join(f"{name} {version}" for name, version in checks["packages"].items()))
    named = {f"provider {name}": check for name, check in checks["providers"].items()}
    named |= {f"extra {name}": check for name, check in checks["extras"].items()}
    named[f"bundled model {checks['model']['name']}"] = checks["model"]
    for name, check in named.items():
        console.print(f"  {name}: {check['says']}", highlight=False, soft_wrap=True)


def _provider(name: str) -> dict[str, Any]:
    from asca_deploy import openvino_session
    from asca_deploy.providers import require

    require(name)
    return {"says": f"ok, {openvino_session.describe()}" if name == "openvino" else "ok"}


def _extra(name: str) -> dict[str, Any]:
    missing = missing_modules(name)
    return {
        "ok": not missing,
        "says": f"missing {', '.join(missing)}: {install_command(name)}" if missing else "ok",
    }


def _bundled_model() -> dict[str, Any]:
    from asca_deploy import Detector
    from asca_deploy.auto import summary
    from asca_deploy.providers import AUTO

    detector = Detector(provider=AUTO)
    return {"says": f"ok, {summary(detector.runs_on, detector.candidates)}", "made_by": detector.made_by}


def _check(attempt: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return {"ok": True} | attempt()
    except AscaError as error:
        return {"ok": False, "says": str(error)}
