"""The column that says who acted: from recordings of takeovers, or on demand, so that LeRobot can merge datasets."""

import json
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_calvin import write_calvin

from dataset_convert import verify
from dataset_convert.convert import convert
from dataset_convert.options import ConvertConfig
from dataset_convert.verify import Mismatch, VerifyConfig
from lerobot_lansar.clip.store import sha256
from lerobot_lansar.datasets import INTERVENTION_FEATURE, MANIFEST


@pytest.fixture
def takeovers(tmp_path):
    """A recording whose frames say who acted: a policy in every third."""
    source = write_calvin(tmp_path / "takeovers", rgb=False)
    for frame, content in source.frames.items():
        content["is_intervention"] = np.array([frame % 3 > 0])
        source.rewrite(frame)
    return source


def test_the_column_is_what_the_frames_say_and_verify_sees_a_change(takeovers, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    out = convert(ConvertConfig(takeovers.root, "me/takeovers", tmp_path / "out", images="none"))
    dataset = LeRobotDataset("me/takeovers", root=out)
    assert dataset.features[INTERVENTION_FEATURE] == {"dtype": "bool", "shape": (1,), "names": None}
    assert all(bool(item[INTERVENTION_FEATURE]) == (int(item["calvin.frame"]) % 3 > 0) for item in dataset)
    assert f"`{INTERVENTION_FEATURE}`" in (out / "README.md").read_text()
    asked = VerifyConfig("me/takeovers", takeovers.root, out)
    verify.verify(asked)
    file, *_ = sorted((out / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    place = table.column_names.index(INTERVENTION_FEATURE)
    changed = pa.array([not value for value in table[INTERVENTION_FEATURE].to_pylist()])
    first = pq.ParquetFile(file).read_row_group(0).num_rows
    pq.write_table(table.set_column(place, INTERVENTION_FEATURE, changed), file, row_group_size=first)
    manifest = json.loads((out / MANIFEST).read_text())
    manifest["files"][str(file.relative_to(out))] = sha256(file)
    (out / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(Mismatch, match=f"column {INTERVENTION_FEATURE} is not what the source says"):
        verify.verify(asked)


def test_lerobots_command_merges_takeovers_with_other_recordings(takeovers, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    plain = write_calvin(tmp_path / "plain", rgb=False)
    roots = [
        convert(ConvertConfig(takeovers.root, "me/takeovers", tmp_path / "a", images="none")),
        convert(ConvertConfig(plain.root, "me/plain", tmp_path / "b", images="none", is_intervention=True)),
    ]
    verify.verify(VerifyConfig("me/plain", plain.root, roots[1]))
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_edit_dataset", "--operation.type=merge"]
    command += ["--new_repo_id=me/both", f"--new_root={tmp_path / 'both'}"]
    command += [
        "--operation.repo_ids=['me/takeovers','me/plain']",
        f"--operation.roots={[str(root) for root in roots]}",
    ]
    subprocess.run(command, check=True, capture_output=True, text=True)
    merged, parts = LeRobotDataset("me/both", root=tmp_path / "both"), [len(pq.read_table(r / "data")) for r in roots]
    acted = np.array([bool(item[INTERVENTION_FEATURE]) for item in merged])
    assert len(acted) == sum(parts)
    assert acted[parts[0] :].all()
    assert 0 < acted[: parts[0]].mean() < 1
