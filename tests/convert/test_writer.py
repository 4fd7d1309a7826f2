"""The files that a shard is written to."""

import os
import subprocess
import sys

from dataset_convert.layout import Codec
from dataset_convert.writer import _options

ENCODE = """
import sys
from pathlib import Path
import numpy as np
from dataset_convert.layout import Codec, Picture
from dataset_convert.writer import Video

rng, size = np.random.default_rng(0), 84
waves = 50 * np.add.outer(np.sin(np.arange(200) / 7), np.cos(np.arange(200) / 9)) + 120
pictures = [waves[i : i + size, 2 * i : 2 * i + size, None] + rng.normal(0, 6, (size, size, 3)) for i in range(12)]
codec = Codec("h264", "yuv444p", {"g": "2", "crf": "18", "preset": "veryfast"})
with Video(Path(sys.argv[1]), Picture("camera", "rgb_gripper", slice(None), (size, size, 3), codec)) as video:
    video.add(np.clip(pictures, 0, 255).astype(np.uint8))
"""


def test_a_video_does_not_depend_on_what_its_memory_held_before(tmp_path):
    """glibc fills new memory with the byte that MALLOC_PERTURB_ names; x264's AVX-512 code reads some of it."""
    for byte in ("1", "99"):
        command = [sys.executable, "-c", ENCODE, str(tmp_path / f"{byte}.mp4")]
        subprocess.run(command, check=True, env=os.environ | {"MALLOC_PERTURB_": byte})
    assert (tmp_path / "1.mp4").read_bytes() == (tmp_path / "99.mp4").read_bytes()
    # processors without AVX-512 never read it: there the option alone tells
    assert _options(Codec("h264", "yuv444p", {"g": "2"}))["x264-params"] == "cpu-independent=1"


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from dataset_convert.layout import Codec, Picture
from dataset_convert.writer import Video

resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
pictures = np.random.default_rng(0).integers(0, 255, (40, 200, 200, 3), np.uint8)
picture = Picture("camera", "rgb_static", slice(None), (200, 200, 3), Codec("h264", "yuv420p", {"g": "2"}))
for frames in (4, 8, 12, 40):
    try:
        with Video(Path(sys.argv[1]), picture) as video:
            video.add(pictures[:frames])
        print("written")
    except OSError as error:
        print(error)
"""


def test_a_full_disk_is_one_error_and_no_traceback_of_a_file_that_was_not_closed(tmp_path):
    command = [sys.executable, "-c", FULL, str(tmp_path / "full.mp4")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.startswith("written")
    assert f"File too large: '{tmp_path}/full.mp4'" in done.stdout.splitlines()[-1]
    assert done.stderr == ""
