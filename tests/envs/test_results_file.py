"""`episodes.jsonl`: one file per evaluation, however many processes write it."""

import json
import multiprocessing

from lerobot_lansar.benchmark import EPISODES_FILE
from lerobot_lansar.envs.episodes import LOCK_FILE, append_episode

WORKERS, LINES = 8, 25


def write(folder, worker, start):
    start.wait()
    for number in range(LINES):
        # longer than a file's buffer, so that a line reaches the file in several pieces
        append_episode(folder, {"worker": worker, "number": number, "text": "x" * 20_000})


def test_forked_workers_append_whole_lines_to_one_file(tmp_path):
    folder = tmp_path / "new" / "results"
    fork = multiprocessing.get_context("fork")
    start = fork.Event()
    workers = [fork.Process(target=write, args=(folder, worker, start)) for worker in range(WORKERS)]
    for worker in workers:
        worker.start()
    start.set()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * WORKERS
    lines = [json.loads(line) for line in (folder / EPISODES_FILE).read_text().splitlines()]
    for worker in range(WORKERS):
        assert [line["number"] for line in lines if line["worker"] == worker] == list(range(LINES))
    assert len(lines) == WORKERS * LINES


def test_the_lock_file_is_hidden_and_empty(tmp_path):
    append_episode(tmp_path, {"seed": 0})
    assert {path.name for path in tmp_path.iterdir()} == {EPISODES_FILE, LOCK_FILE}
    assert LOCK_FILE.startswith(".")
    assert (tmp_path / LOCK_FILE).stat().st_size == 0


def test_a_second_evaluation_in_the_same_folder_appends(tmp_path):
    for seed in (0, 1):
        append_episode(tmp_path, {"seed": seed})
    assert (tmp_path / EPISODES_FILE).read_text() == '{"seed": 0}\n{"seed": 1}\n'
