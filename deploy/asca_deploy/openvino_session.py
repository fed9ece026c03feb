"""Graphs in OpenVINO on the CPU: Intel's, AMD's and ARM's alike.

The package `openvino` is used as it is, not through onnxruntime: its plugin for onnxruntime (onnxruntime-ep-openvino
1.8) offers no device on CPUs that are not Intel's, though OpenVINO runs on them.
"""

import importlib.util
import sys
import threading
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.graph import Tensor
from asca_pillars.base.errors import BundleError, ProviderError
from asca_pillars.base.installation import install_command

if TYPE_CHECKING:
    import openvino

_DEVICE = "CPU"
_HINTS = {"float32": "f32", "reduced": "bf16"}
_TYPES = {"f32": "float32", "u8": "uint8", "i32": "int32", "i64": "int64"}


def require(precision: str) -> None:
    """Raise ProviderError, which says what to install or to choose, unless OpenVINO computes in this precision here."""
    if importlib.util.find_spec("openvino") is None:
        raise ProviderError(f"provider openvino is not installed: `{install_command('openvino')}`")
    if precision == "reduced" and not _has_bfloat16():
        raise ProviderError(
            f"provider openvino has no precision reduced on this CPU ({_device_name()}), which lacks bfloat16; "
            "choose float32, or a bundle made with `asca export --int8`"
        )


def describe() -> str:
    """Describe the installed OpenVINO and its device; `require` must have found it."""
    bfloat16 = "with bfloat16" if _has_bfloat16() else "without bfloat16"
    return f"OpenVINO {_import_openvino().__version__.split('-')[0]} on {_device_name()} {bfloat16}"


def _has_bfloat16() -> bool:
    return "BF16" in _core().get_property(_DEVICE, "OPTIMIZATION_CAPABILITIES")


def _device_name() -> str:
    return str(_core().get_property(_DEVICE, "FULL_DEVICE_NAME")).strip()


class OpenVinoSession:
    """A graph opened by OpenVINO, see `graph.Session`.

    Raises:
        ProviderError: OpenVINO does not start.
        BundleError: OpenVINO cannot read or run the graph.
    """

    def __init__(self, path: Path, precision: str, threads: int) -> None:
        self._path, self._openvino = path, _import_openvino()
        self._version = self._openvino.__version__.split("-")[0]
        try:
            core = _core()
            model = core.compile_model(core.read_model(path), _DEVICE, _properties(precision, threads))
        except RuntimeError as error:  # the only one OpenVINO knows
            raise BundleError(
                f"OpenVINO {self._version} cannot run {path}: {_last_line(error)}; "
                f"upgrade with `pip install --upgrade openvino`, or choose provider cpu"
            ) from error
        self._request = model.create_infer_request()
        self._lock = threading.Lock()
        self.inputs = {name: _tensor(port) for port in model.inputs for name in port.names}
        self.outputs = {name: _tensor(port) for port in model.outputs for name in port.names}
        self._ports = {name: number for number, port in enumerate(model.outputs) for name in port.names}
        if not all(port.partial_shape.is_static for port in model.outputs):
            raise BundleError(f"{path}: its outputs have no fixed shapes, which OpenVINO needs; choose provider cpu")
        self._results = [(tuple(port.shape), port.element_type.to_dtype()) for port in model.outputs]

    def run(self, outputs: Sequence[str], inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """See `graph.Session.run`; OpenVINO writes into new arrays, so that nothing is copied.

        Inputs and outputs have the graph's fixed shapes, such as (1, ny + 1, nx + 1, C).

        Raises:
            ProviderError: OpenVINO fails, for example for want of memory.
        """
        results = [np.empty(shape, kind) for shape, kind in self._results]
        try:
            with self._lock:  # a request refuses a second caller, and one network keeps all cores busy
                for port, array in enumerate(results):
                    self._request.set_output_tensor(port, self._openvino.Tensor(array, shared_memory=True))
                self._request.infer(dict(inputs), share_inputs=True)
        except RuntimeError as error:
            raise ProviderError(
                f"OpenVINO {self._version} failed while it ran {self._path}: {_last_line(error)}; "
                "provider cpu may run it"
            ) from error
        return [results[self._ports[name]] for name in outputs]


def _last_line(error: RuntimeError) -> str:
    """Return the last line of OpenVINO's message, the most specific one."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()


def _tensor(port: Any) -> Tensor:
    kind = port.element_type.get_type_name()
    shape = (size.get_length() if size.is_static else None for size in port.partial_shape)
    return Tensor(_TYPES.get(kind, kind), tuple(shape))


def _properties(precision: str, threads: int) -> dict[str, Any]:
    return {
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": 1,
        "INFERENCE_PRECISION_HINT": _HINTS[precision],
        "INFERENCE_NUM_THREADS": threads,
        # Every process pins its threads to the same first cores, where they then wait for each other.
        "ENABLE_CPU_PINNING": False,
    }


@cache
def _core() -> "openvino.Core":
    core = _import_openvino().Core()
    if _DEVICE not in core.available_devices:
        raise ProviderError(
            "provider openvino finds no CPU that it can use; reinstall it: `pip install --force-reinstall openvino`"
        )
    return core


@cache
def _import_openvino() -> Any:
    """Import the package without its report to the manufacturer.

    It sends one at every import unless its telemetry package cannot be imported.
    """
    telemetry = "openvino_telemetry"
    absent = telemetry not in sys.modules
    if absent:
        sys.modules[telemetry] = None  # type: ignore[assignment]  # Python's way to say that there is no such module
    try:
        import openvino
    except ImportError as error:
        raise ProviderError(
            f"provider openvino cannot be imported ({error}); reinstall it: `pip install --force-reinstall openvino`"
        ) from error
    finally:
        if absent:
            del sys.modules[telemetry]
    return openvino
