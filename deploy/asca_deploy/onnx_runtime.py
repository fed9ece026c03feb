"""The only import of onnxruntime, after its telemetry has been disabled."""

from asca_pillars.base.telemetry import disable_telemetry, onnxruntime_may_report

disable_telemetry()

import onnxruntime  # noqa: E402  (it reads the environment when it is imported)

__all__ = ["onnxruntime"]

if not onnxruntime_may_report():
    onnxruntime.disable_telemetry_events()  # for the case that the caller had imported it before
