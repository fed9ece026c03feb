"""Graphs in ONNX Runtime: on the CPU, and on NVIDIA GPUs where its GPU build is installed."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from asca_deploy.graph import Tensor, first_line
from asca_deploy.onnx_runtime import onnxruntime
from asca_pillars.base.errors import BundleError, ProviderError, printable

OLDEST = (1, 25)

_LONGEST_REASON = 300  # onnxruntime tells whole call stacks
_OTHER_VERSION = "upgrade with `pip install --upgrade onnxruntime`, or export the bundle again"
_OUT_OF_MEMORY = re.compile("allocat|memory", re.IGNORECASE)

# It turns layers that an 8-bit bundle keeps in floating point into 8-bit ones of its own making.
_DISABLED_OPTIMIZERS = ["WeightBiasQuantization"]
_ERRORS_ONLY = 3  # onnxruntime's severities: 0 verbose, 1 info, 2 warning, 3 error
_TYPES = {"tensor(float)": "float32", "tensor(uint8)": "uint8", "tensor(int32)": "int32", "tensor(int64)": "int64"}


@dataclass(frozen=True)
class OrtProvider:
    """One of onnxruntime's execution providers.

    Attributes:
        ort_name: onnxruntime's name for it.
        remedy: what the user can do to get it.
        options: handed to onnxruntime, by precision; a precision that is not there cannot be had.
        helpers: providers for operators that this one does not support, before the CPU.
    """

    ort_name: str
    remedy: str
    options: Mapping[str, Mapping[str, str]]
    helpers: tuple[str, ...] = ()


_CUDA_REMEDY = (
    "it needs an NVIDIA GPU and onnxruntime-gpu in place of onnxruntime: `pip uninstall onnxruntime`, "
    "`pip install 'onnxruntime-gpu[cuda,cudnn]>=1.25'`"
)

ORT_PROVIDERS = {
    "cpu": OrtProvider("CPUExecutionProvider", "reinstall onnxruntime", {"float32": {}}),
    # TF32 keeps 10 bits of mantissa, and onnxruntime uses it unless it is told not to.
    "cuda": OrtProvider(
        "CUDAExecutionProvider", _CUDA_REMEDY, {"float32": {"use_tf32": "0"}, "reduced": {"use_tf32": "1"}}
    ),
    "tensorrt": OrtProvider(
        "TensorrtExecutionProvider",
        f"{_CUDA_REMEDY}, and TensorRT: `pip install tensorrt`",
        {"float32": {}, "reduced": {"trt_fp16_enable": "1"}},
        helpers=("cuda",),
    ),
}


def check_onnxruntime() -> None:
    """Raise ProviderError if the installed onnxruntime is one that computes wrong results."""
    version = re.match(r"(\d+)\.(\d+)", onnxruntime.__version__)
    if version is None or tuple(map(int, version.groups())) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise ProviderError(
            f"onnxruntime {onnxruntime.__version__} is too old: before {oldest} it computes wrong int8 results on CPUs "
            f"with AMX; `pip install --upgrade 'onnxruntime>={oldest}'`, or onnxruntime-gpu if that is what you have"
        )


def require(name: str, precision: str) -> None:
    """Raise ProviderError, which says what to install or to choose, unless onnxruntime has the provider."""
    provider, available = ORT_PROVIDERS[name], onnxruntime.get_available_providers()
    if provider.ort_name not in available:
        usable = [other for other, entry in ORT_PROVIDERS.items() if entry.ort_name in available]
        raise ProviderError(
            f"provider {name} is not in this onnxruntime {onnxruntime.__version__}, which has"
            f" {', '.join(usable)}; {provider.remedy}"
        )
    if precision not in provider.options:
        raise ProviderError(
            f"provider {name} has no precision {precision}, only {', '.join(provider.options)}; provider openvino has "
            "where the CPU has bfloat16, and `asca export --int8` makes a bundle that is fast everywhere"
        )
    # onnxruntime has no option for it (onnxruntime issue 26029).
    if name == "tensorrt" and precision == "float32" and os.environ.get("NVIDIA_TF32_OVERRIDE") != "0":
        raise ProviderError(
            "provider tensorrt computes float32 as TF32 unless the environment forbids it: "
            "set NVIDIA_TF32_OVERRIDE=0 before the start, or choose precision reduced"
        )


class OrtSession:
    """A graph opened by onnxruntime, see `graph.Session`.

    Raises:
        ProviderError: the provider does not start.
        BundleError: onnxruntime cannot read or run the graph at all.
    """

    def __init__(self, path: Path, provider: str, precision: str, threads: int, *, keep_memory: bool = True) -> None:
        options = _session_options(threads)
        options.enable_cpu_mem_arena = keep_memory
        self._path, self._provider = path, provider
        self._session = _open(path, provider, precision, options)
        self.inputs = {node.name: _tensor(node) for node in self._session.get_inputs()}
        self.outputs = {node.name: _tensor(node) for node in self._session.get_outputs()}

    def run(self, outputs: Sequence[str], inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """See `graph.Session.run`: inputs and outputs of the shapes that the graph declares.

        Raises:
            ProviderError: it fails on other hardware than the CPU, for example because memory ran out.
            BundleError: it fails on the CPU.
        """
        try:
            return self._session.run(outputs, inputs)
        except Exception as error:  # onnxruntime's exceptions share no other base
            reason = printable(first_line(error), _LONGEST_REASON)
            failed = f"onnxruntime {onnxruntime.__version__} failed while it ran {self._path}: {reason}"
            if _OUT_OF_MEMORY.search(reason):
                failed += "; give it more memory, or fewer points at once"
            if self._provider != "cpu":
                raise ProviderError(f"{failed}; provider cpu may run it") from error
            raise BundleError(f"{failed}; {_OTHER_VERSION}") from error


def _tensor(node: Any) -> Tensor:
    shape = tuple(size if isinstance(size, int) else None for size in node.shape)
    return Tensor(_TYPES.get(node.type, node.type), shape)


def _open(path: Path, name: str, precision: str, options: onnxruntime.SessionOptions) -> onnxruntime.InferenceSession:
    if name != "cpu":
        onnxruntime.preload_dlls()  # CUDA and cuDNN from pip's nvidia packages lie where no loader looks
    chain = [ORT_PROVIDERS[link] for link in (name, *ORT_PROVIDERS[name].helpers)]
    providers = [(entry.ort_name, dict(entry.options[precision])) for entry in chain]
    if name != "cpu":
        providers.append((ORT_PROVIDERS["cpu"].ort_name, {}))
    try:
        session = onnxruntime.InferenceSession(
            str(path),
            options,
            providers=providers,
            enable_fallback=0,
            disabled_optimizers=_DISABLED_OPTIMIZERS,
        )
    except Exception as error:  # onnxruntime's exceptions share no other base
        reason = first_line(error)
        if name != "cpu":
            raise ProviderError(f"provider {name} cannot run {path}: {reason}; {chain[0].remedy}") from error
        raise BundleError(
            f"onnxruntime {onnxruntime.__version__} cannot run {path}: {reason}; {_OTHER_VERSION}"
        ) from error
    if session.get_providers()[0] != chain[0].ort_name:
        raise ProviderError(f"provider {name} does not start on this machine; {chain[0].remedy}")
    return session


def _session_options(threads: int) -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = _ERRORS_ONLY
    # Threads that spin after one graph's run would take the cores from the other graph and from NumPy.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    return options
