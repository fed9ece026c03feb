"""`asca view`: scans and their boxes in 3D in the browser."""

from typing import Annotated

import typer

from asca_pillars.cli.options import (
    AxesOption,
    BundleOption,
    ColumnsOption,
    PoseOption,
    PrecisionOption,
    ProviderOption,
    ReflectanceScaleOption,
    ScansArgument,
    ScoreOption,
    SensorHeightOption,
    ThreadsOption,
    ViewOption,
    read_scores,
    scan_settings,
)


def view(
    scans: ScansArgument = None,
    *,
    bundle: BundleOption = None,
    around: ViewOption = None,
    sensor_height: SensorHeightOption = None,
    axes: AxesOption = "x-forward",
    pose: PoseOption = None,
    reflectance_scale: ReflectanceScaleOption = "auto",
    columns: ColumnsOption = None,
    port: Annotated[
        int,
        typer.Option(
            "--port",
            min=0,
            max=65535,
            help="Port of 127.0.0.1 to serve on. Default: a free one.",
            show_default=False,
            rich_help_panel="Output",
            metavar="PORT",
        ),
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address only; open no browser.", rich_help_panel="Output")
    ] = False,
    score: ScoreOption = None,
    provider: ProviderOption = "cpu",
    precision: PrecisionOption = None,
    threads: ThreadsOption = None,
) -> None:
    """Show scans and the boxes found in them in 3D, in a browser on this computer, until Ctrl-C.

    The arrow keys go from scan to scan; each is detected when it is shown. The page is served on 127.0.0.1 alone, and
    needs no network.

    Examples:

    asca view my_scans/

    asca view sweeps/ --axes y-forward --sensor-height auto

    asca view scan.pcd --port 8000 --no-browser
    """
    import logging
    import threading
    import webbrowser

    from asca_deploy.open_model import RuntimeOptions
    from asca_deploy.view_scans import ScanServer

    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # its warnings are on the page
    reading = scan_settings(
        sensor_height=sensor_height, axes=axes, pose=pose, reflectance_scale=reflectance_scale, columns=columns
    )
    options = RuntimeOptions(bundle=bundle, provider=provider, precision=precision, threads=threads)
    with ScanServer(scans, port, options=options, reading=reading, score=read_scores(score), around=around) as server:
        for line in server.notes:
            print(line)
        count = len(server.names)
        print(f"{count} scan{'s' if count != 1 else ''}: {server.address} (Ctrl-C ends)", flush=True)
        if not no_browser:  # in a thread: a terminal browser returns only when it is closed
            threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
        try:
            server.serve()
        except KeyboardInterrupt:
            print()
