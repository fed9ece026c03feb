"""`asca doctor`: what runs here, and what to install for the rest."""


def doctor() -> None:
    """Say what is installed, what can run here, and what to install for the rest."""
    from rich.console import Console

    from asca_pillars.cli.doctor_checks import print_checks

    print_checks(Console(markup=False))
