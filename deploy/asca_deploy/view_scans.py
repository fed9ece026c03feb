"""Local web page of scans and their boxes; detection runs in Python, and only this computer is served.

The page is that of `browser_page` without its detector: it asks for the points of a scan, shows them, and asks for the
boxes. Only fixed paths are answered, only requests that name this computer as their host, so that a page of somebody
else's, which the same browser has open, cannot read them through a name that resolves to 127.0.0.1.
"""

import errno
import json
import re
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast

import numpy as np

from asca_deploy.browser_page import PAGE, page_modules
from asca_deploy.detector import Detector
from asca_deploy.open_model import RuntimeOptions, files_need_around, open_detector
from asca_deploy.result_files import scan_content
from asca_deploy.scan_detections import ScanDetections
from asca_deploy.shipped import sample_scan_path
from asca_pillars.base.errors import AscaError, ConfigError, printable
from asca_pillars.data.boxes.detector_scope import detector_scope
from asca_pillars.detection.spec import ScoreThresholds
from asca_pillars.pictures.colors import color_table, height_table
from asca_pillars.scans.find_scans import name_scans
from asca_pillars.scans.recordings.recorded_scans import is_recording
from asca_pillars.scans.scan_reader import Scan
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings

HOST = "127.0.0.1"
LOWEST_SCORE = 0.1
"""Lowest end of the page's score sliders with a single pass; in merging several, low boxes would remove others."""
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".bin": "application/octet-stream",
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; connect-src 'self' blob:; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_SCAN = re.compile(r"/scans/(0|[1-9][0-9]{0,8})\.(bin|json)", re.ASCII)
_PLAIN = RuntimeOptions()
_AS_TRAINED = ScanSettings()


class ScanServer:
    """Server of a page of scans on a local port; as a context manager it releases the port.

    Args:
        scans: files and folders; None: the sample that comes with the package.
        port: to listen on; 0: a free one.
        options: which model runs, and how.
        reading: how the files are read and the sensor was mounted.
        score: show detections from this score on, or by class; None: the thresholds of the model.
        around: detect in every direction, see `asca_deploy.around`; None: if the first scan lies all around the sensor.

    Attributes:
        address: where the page is.
        names: of the scans, in the order in which the page shows them.
        notes: sentences about what was decided for the scans.

    Raises:
        ScanError: there are no scans, or the first cannot be read.
        ConfigError: a recording, or a port that is in use.
        AscaError: the model cannot be opened; one line with the remedy.
    """

    def __init__(
        self,
        scans: Sequence[str | Path] | None = None,
        port: int = 0,
        *,
        options: RuntimeOptions = _PLAIN,
        reading: ScanSettings = _AS_TRAINED,
        score: ScoreThresholds | None = None,
        around: bool | None = None,
    ) -> None:
        chosen = [Path(path) for path in scans or [sample_scan_path()]]
        if recording := next(filter(is_recording, chosen), None):
            raise ConfigError(f"{recording}: is a recording; look at it with asca detect --rerun or --foxglove")
        named = name_scans(chosen)
        paths = [scan.path for scan in named]
        scan_input = ScanInput(reading, paths)
        around = files_need_around(options, scan_input) if around is None else around
        detector = open_detector(options, score, scan_input.mounting, around=around)
        thresholds = {class_spec.name: class_spec.score_threshold for class_spec in detector.spec.classes}
        lowest = {
            name: min(value, LOWEST_SCORE) if detector.passes == 1 else value for name, value in thresholds.items()
        }
        detector.spec = detector.pipeline.spec = detector.spec.with_score_threshold(lowest)
        self.names = [scan.name.as_posix() + scan.path.suffix for scan in named]
        self.notes = tuple(scan_input.notes)
        answers = _ScanContents(paths, scan_input, detector, around=around)
        answers.boxes(0)  # errors that concern all scans are raised before the page opens
        files = {f"/{file.name}": file.read_bytes() for file in page_modules()}
        files["/"] = files["/index.html"]
        page = {
            "bundle": detector.bundle.name,
            "runs_on": detector.runs_on,
            "scans": self.names,
            "classes": [{"name": name, "score": value, "lowest": lowest[name]} for name, value in thresholds.items()],
            "limit": detector.spec.post.max_detections,
            "colors": color_table(detector.spec.class_names),
            "heights": height_table(),
        }
        files[f"/{PAGE}"] = _json(page)

        def answer(path: str) -> tuple[str, bytes] | None:
            if path in files:
                return (".html" if path == "/" else Path(path).suffix), files[path]
            match = _SCAN.fullmatch(path)
            if match is None or int(match[1]) >= len(paths):
                return None
            made = answers.points if match[2] == "bin" else answers.boxes
            return f".{match[2]}", made(int(match[1]))

        try:
            self._server = _Server((HOST, port), _handler(answer))
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise ConfigError(f"--port {port}: {error.strerror}; leave it out for a free one") from None
        self.address = f"http://{HOST}:{self._server.server_port}/"

    def serve(self) -> None:
        """Answer requests until `stop`, or until KeyboardInterrupt, which passes."""
        self._server.serve_forever(poll_interval=0.1)

    def stop(self) -> None:
        """Let `serve`, which runs in another thread, return."""
        self._server.shutdown()

    def __enter__(self) -> "ScanServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True  # a browser's open connection does not hold up the end


class _ScanContents:
    """Points and boxes of scans by their number; requests are handled one at a time."""

    def __init__(self, paths: Sequence[Path], scan_input: ScanInput, detector: Detector, *, around: bool) -> None:
        self._paths, self._detector = paths, detector
        self._level = None if detector.mounting.level.is_identity else detector.mounting.level
        self._scope = detector_scope(detector.spec, around=around)
        self._lock = threading.Lock()
        self._read: Callable[[int], Scan] = lru_cache(maxsize=1)(lambda number: scan_input.read(paths[number]))

    def points(self, number: int) -> bytes:
        """Return the points of a scan in a level frame, little-endian float32 x, y, z, reflectance."""
        with self._lock:
            points = self._read(number).points
        if self._level is not None:
            points = self._level.points(points)
        return np.ascontiguousarray(points, "<f4").tobytes()

    def boxes(self, number: int) -> bytes:
        """Return the page's content for a scan; `save` is what `asca detect` writes of it."""
        with self._lock:
            scan = self._read(number)
            detections = self._detector(scan.points)
        content = scan_content(self._paths[number], scan, detections, self._scope)
        answer = {
            "detections": _level_boxes(detections),
            "timesMs": detections.report.times_ms,
            "remarks": content["warnings"],
            "save": content,
        }
        return _json(answer)


def _level_boxes(detections: ScanDetections) -> list[dict[str, Any]]:
    """Return class, score and box (7 numbers) of each detection, x forward, y left, z up, in the scan's order."""
    boxes = detections.boxes if detections.level is None else detections.level.boxes(detections.boxes)
    return [
        {"class": name, "score": float(score), "box": [float(value) for value in box]}
        for name, score, box in zip(detections.names, detections.scores, boxes, strict=True)
    ]


def _json(content: Any) -> bytes:
    return json.dumps(content, allow_nan=False).encode()


def _handler(answer: Callable[[str], tuple[str, bytes] | None]) -> type[BaseHTTPRequestHandler]:
    """Make the class that answers requests; `answer` gives suffix and content for a path, or None."""

    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "asca", ""
        timeout = 60

        def do_GET(self) -> None:
            _, port = cast(tuple[str, int], self.server.server_address)
            if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
                self._send(HTTPStatus.FORBIDDEN, ".txt", b"asked for under another name")
                return
            try:
                content = answer(self.path)
            except (AscaError, OSError) as error:
                self._send(HTTPStatus.UNPROCESSABLE_ENTITY, ".txt", printable(str(error)).encode())
                return
            if content is None:
                self._send(HTTPStatus.NOT_FOUND, ".txt", b"there is no such file")
            else:
                self._send(HTTPStatus.OK, *content)

        def log_message(self, *_: Any) -> None:
            pass

        def _send(self, status: HTTPStatus, suffix: str, content: bytes) -> None:
            self.send_response(status)
            headers = {"Content-Type": _TYPES.get(suffix, "text/plain; charset=utf-8"), **_HEADERS}
            for name, value in {**headers, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            try:
                self.wfile.write(content)
            except ConnectionError:
                self.close_connection = True  # the page went elsewhere meanwhile

    return Handler
