"""Skips where no encoder of videos is installed."""

import importlib.util
import shutil

import pytest

HAS_ENCODER = importlib.util.find_spec("imageio_ffmpeg") is not None or shutil.which("ffmpeg") is not None
needs_encoder = pytest.mark.skipif(not HAS_ENCODER, reason="needs pip install -e '.[video]', or ffmpeg")
