"""The files that a shard is written to."""

import os
import subprocess
import sys

ENCODE = """
import sys
from pathlib import Path
import numpy as np
from dataset_convert.layout import Codec, Picture
from dataset_convert.writer import Video

rng, size = np.random.default_rng(0), 84
waves = 50 * np.add.outer(np.sin(np.arange(200) / 7), np.cos(np.arange(200) / 9)) + 120
pictures = [waves[i : i + size, 2 * i : 2 * i + size, None] + rng.normal(0, 6, (size, size, 3)) for i in range(12)]
codec = Codec("h264", "yuv420p", {"g": "2", "crf": "18", "preset": "veryfast"})
with Video(Path(sys.argv[1]), Picture("camera", "rgb_gripper", slice(None), (size, size, 3), codec)) as video:
    video.add(np.clip(pictures, 0, 255).astype(np.uint8))
"""


def test_a_video_does_not_depend_on_what_its_memory_held_before(tmp_path):
    """glibc fills new memory with the byte that MALLOC_PERTURB_ names; x264's AVX-512 code reads some of it."""
    for byte in ("1", "99"):
        command = [sys.executable, "-c", ENCODE, str(tmp_path / f"{byte}.mp4")]
        subprocess.run(command, check=True, env=os.environ | {"MALLOC_PERTURB_": byte})
    assert (tmp_path / "1.mp4").read_bytes() == (tmp_path / "99.mp4").read_bytes()
