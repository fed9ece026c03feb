"""`asca doctor`: what runs here, and what to install for the rest."""


def doctor() -> None:
    """Say what is installed, what can run here, and what to install for the rest."""
    from rich.console import Console

    from asca_deploy.doctor import examine

    console = Console(markup=False)
    found = examine()
    console.print(found.machine)
    console.print(", ".join(f"{name} {version}" for name, version in found.versions.items()))
    for check in found.checks:
        console.print(f"  {check.name}: {check.text}", highlight=False, soft_wrap=True)
