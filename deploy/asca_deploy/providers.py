"""Which hardware the graphs run on.

A provider that was asked for and cannot run is an error, never a silent fallback to the CPU.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import onnxruntime

from asca_pillars.errors import AscaError, BundleError

_ERRORS_ONLY = 3  # onnxruntime's severities: 0 verbose, 1 info, 2 warning, 3 error


class ProviderError(AscaError):
    """An execution provider that is not installed or does not start."""


@dataclass(frozen=True)
class Provider:
    """One of onnxruntime's execution providers.

    Attributes:
        ort_name: onnxruntime's name for it.
        remedy: what the user can do to get it.
        options: handed to onnxruntime.
        helpers: providers that take the operators this one does not know, before the CPU does.
    """

    ort_name: str
    remedy: str
    options: dict[str, str] = field(default_factory=dict)
    helpers: tuple[str, ...] = ()


_CUDA_REMEDY = (
    "it needs an NVIDIA GPU and onnxruntime-gpu in place of onnxruntime: `pip uninstall onnxruntime`, "
    "`pip install 'onnxruntime-gpu[cuda,cudnn]>=1.25'`"
)
# The bundle's parity was proven in float32; TF32 keeps 10 bits of mantissa.
_CUDA_OPTIONS = {"use_tf32": "0"}

PROVIDERS = {
    "cpu": Provider("CPUExecutionProvider", "reinstall onnxruntime"),
    "cuda": Provider("CUDAExecutionProvider", _CUDA_REMEDY, _CUDA_OPTIONS),
    "tensorrt": Provider(
        "TensorrtExecutionProvider",
        f"{_CUDA_REMEDY}, and TensorRT: `pip install tensorrt`",
        helpers=("cuda",),
    ),
    "openvino": Provider("OpenVINOExecutionProvider", "it needs a build of onnxruntime >= 1.25 that contains OpenVINO"),
    "coreml": Provider("CoreMLExecutionProvider", "it comes with onnxruntime on macOS"),
}

# Only providers that compute in float32 as the export's proof did and start within seconds.
AUTO_ORDER = ("cuda", "cpu")


def select_providers(requested: str = "cpu", available: Sequence[str] | None = None) -> list[str]:
    """Names of PROVIDERS to try, in order: `requested` alone, or for "auto" all that this onnxruntime has.

    Args:
        available: onnxruntime's names of the providers at hand; None asks the installed onnxruntime.

    Raises:
        ProviderError: an unknown name, or a provider that this onnxruntime lacks; says what to install.
    """
    available = onnxruntime.get_available_providers() if available is None else available
    at_hand = [name for name, provider in PROVIDERS.items() if provider.ort_name in available]
    if requested == "auto":
        return [name for name in AUTO_ORDER if name in at_hand]
    if requested not in PROVIDERS:
        raise ProviderError(f"unknown provider {requested!r}; choose one of auto, {', '.join(PROVIDERS)}")
    if requested not in at_hand:
        raise ProviderError(
            f"provider {requested} is not in this onnxruntime {onnxruntime.__version__}, which has"
            f" {', '.join(at_hand)}; {PROVIDERS[requested].remedy}"
        )
    return [requested]


def open_session(graph: Path, names: Sequence[str], threads: int) -> tuple[onnxruntime.InferenceSession, str]:
    """Open an ONNX file on the first of the providers `names` that starts; returns the session and that name.

    Raises:
        ProviderError: none of them starts.
        BundleError: onnxruntime cannot read or run the graph at all.
    """
    for name in names[:-1]:
        try:
            return _open(graph, name, threads), name
        except ProviderError:
            continue
    return _open(graph, names[-1], threads), names[-1]


def _open(graph: Path, name: str, threads: int) -> onnxruntime.InferenceSession:
    if name in ("cuda", "tensorrt"):
        onnxruntime.preload_dlls()  # CUDA and cuDNN from pip's nvidia packages lie where no loader looks
    chain = [name, *PROVIDERS[name].helpers]
    providers = [(PROVIDERS[link].ort_name, PROVIDERS[link].options) for link in chain]
    if name != "cpu":
        providers.append((PROVIDERS["cpu"].ort_name, {}))
    try:
        session = onnxruntime.InferenceSession(
            str(graph), _session_options(threads), providers=providers, enable_fallback=0
        )
    except Exception as error:  # onnxruntime's exceptions share no other base
        reason = str(error).splitlines()[0]
        if name != "cpu":
            raise ProviderError(f"provider {name} cannot run {graph}: {reason}; {PROVIDERS[name].remedy}") from error
        raise BundleError(
            f"onnxruntime {onnxruntime.__version__} cannot run {graph}: {reason}; "
            "upgrade with `pip install --upgrade onnxruntime`, or export the bundle again"
        ) from error
    if session.get_providers()[0] != PROVIDERS[name].ort_name:
        raise ProviderError(f"provider {name} does not start on this machine; {PROVIDERS[name].remedy}")
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
