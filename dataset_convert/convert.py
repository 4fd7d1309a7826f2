"""``lansar-convert``: a split of a CALVIN dataset becomes a LeRobotDataset v3."""

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
import numpy as np
from draccus.utils import DraccusException
from tqdm import tqdm

from dataset_convert import checks
from dataset_convert.calvin import CAMERAS, VECTORS, CalvinSplit
from dataset_convert.card import describe
from dataset_convert.publish import publishing

if TYPE_CHECKING:  # importing LeRobot takes seconds: a mistyped option is reported before that
    from dataset_convert.writer import Episode

EPISODES_PER_SHARD = 200
"""One parquet file and one mp4 per camera (about 30 MB) hold this many episodes."""

MANIFEST = Path("meta") / "calvin_source.json"


@dataclass
class ClipOptions:
    """Which CLIP embeds the pictures."""

    # open_clip's model name
    model: str = "ViT-B-32"
    # open_clip's tag of the weights, or a weights file; empty: untrained
    pretrained: str = "openai"


@dataclass
class ConvertConfig:
    """Converts the language-annotated windows of a CALVIN split to a LeRobotDataset v3 at 30 fps."""

    # folder of the CALVIN dataset, the one that holds training/ and validation/
    root: Path
    # name of the dataset, you/name; also its place on the hub
    repo_id: str
    # folder to create
    output_dir: Path
    # which split to convert
    split: str = "training"
    # what `action` holds: rel (relative) or abs (absolute); the other form is kept in another column
    action: str = "rel"
    # store both cameras as videos
    videos: bool = True
    # codec of the videos, as LeRobot names them
    vcodec: str = "libsvtav1"
    # compute CLIP embeddings of the pictures and store them beside the data
    embed: bool = False
    clip: ClipOptions = field(default_factory=ClipOptions)
    # processes that convert in parallel
    workers: int = 1
    # upload to the hub when done
    push_to_hub: bool = False
    # make the uploaded dataset private
    private: bool = False


@dataclass
class _Job:
    """What every shard needs; sent to each worker once."""

    split: CalvinSplit
    root: Path
    info: Any
    action: str
    cameras: list[str]
    vcodec: str
    encoder_threads: int | None
    block_orders: dict[str, tuple[str, ...]]
    task_index: dict[str, int]

    def episodes(self, first: int, count: int, on_episode: Callable[[], object]) -> "Iterator[Episode]":
        """Reads and checks the windows of one shard, one at a time."""
        from dataset_convert.writer import IMAGE_KEYS, Episode

        for window in self.split.windows[first : first + count]:
            read = self.split.read(range(window.start, window.end), [*VECTORS, *self.cameras])
            checks.check_window({key: read[key] for key in VECTORS}, window, self.split)
            main, other = ("rel_actions", "actions") if self.action == "rel" else ("actions", "rel_actions")
            columns = {
                "observation.state": read["robot_obs"],
                "observation.environment_state": checks.reorder_blocks(
                    read["scene_obs"], self.block_orders[window.scene]
                ),
                "action": read[main],
                f"calvin.{other}": read[other],
            }
            columns = {key: column.astype(np.float32) for key, column in columns.items()}
            columns["calvin.frame"] = np.arange(window.start, window.end)
            images = {IMAGE_KEYS[camera]: read[camera] for camera in self.cameras}
            yield Episode(window.sentence, columns, images)
            on_episode()

    def write(self, shard: int, on_episode: Callable[[], object]) -> dict:
        """Writes one shard; returns its statistics."""
        from dataset_convert.writer import Place, write_shard

        first = shard * EPISODES_PER_SHARD
        place = Place(shard, first, sum(len(window) for window in self.split.windows[:first]))
        episodes = self.episodes(first, EPISODES_PER_SHARD, on_episode)
        return write_shard(
            self.root, self.info, place, episodes, self.task_index, self.vcodec, self.encoder_threads
        )


def convert(config: ConvertConfig) -> Path:
    """Converts a split; the dataset appears at ``output_dir`` complete or not at all.

    Args:
        config: the command's options.

    Returns:
        The dataset's folder. If it already holds the result of the same request, nothing is done.

    Raises:
        FileNotFoundError: a file of the source is missing.
        ValueError: an option or the source's content is wrong, or ``output_dir`` holds something else.
    """
    _check_options(config)
    split = CalvinSplit(config.root, config.split)
    clip = {"model": config.clip.model, "pretrained": Path(config.clip.pretrained).name}
    request = {
        "source": config.root.resolve().name,
        "split": config.split,
        "source_sha256": split.source_sha256,
        "action": config.action,
        "videos": config.videos,
        "vcodec": config.vcodec if config.videos else None,
        "clip": clip if config.embed else None,
    }
    if _is_done(config.output_dir, request):
        print(f"{config.output_dir} already holds this conversion", file=sys.stderr)
        return config.output_dir
    cameras = list(CAMERAS) if config.videos else []
    # Before the long part, so that a folder without pictures is reported at once.
    split.read([split.windows[0].start], [*VECTORS, *(CAMERAS if config.embed else cameras)])
    scenes = sorted({window.scene for window in split.windows})
    orders = {scene: checks.block_order(scene, checks.block_votes(split, scene)) for scene in scenes}
    for scene, order in orders.items():
        if order != checks.SCENE_BLOCK_ORDER.get(scene):
            print(f"scene {scene}: block columns are {', '.join(order)}, as its lifts show", file=sys.stderr)
    tasks = list(dict.fromkeys(window.sentence for window in split.windows))

    from dataset_convert import embed, writer

    clip_model = embed.load_clip(config.clip.model, config.clip.pretrained) if config.embed else None
    writer.check_codec(config.vcodec)
    info = writer.empty_info(config.action, config.videos)
    with publishing(config.output_dir) as root:
        job = _Job(
            split=split,
            root=root,
            info=info,
            action=config.action,
            cameras=cameras,
            vcodec=config.vcodec,
            encoder_threads=1 if config.workers > 1 else None,
            block_orders=orders,
            task_index={sentence: number for number, sentence in enumerate(tasks)},
        )
        stats = _run(job, config.workers)
        lengths = [len(window) for window in split.windows]
        writer.write_whole(root, info, tasks, lengths, stats, config.vcodec)
        manifest = {
            "request": request,
            "scenes": {
                scene: {"frames": list(split.scenes[scene]), "block_order": list(order)}
                for scene, order in orders.items()
            },
            "versions": {name: version(name) for name in ("lerobot_policy_lansar", "lerobot", "numpy", "av")},
            "episodes": [
                {"start": w.start, "end": w.end, "task": w.task, "sentence": w.sentence, "scene": w.scene}
                for w in split.windows
            ],
        }
        (root / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
        if clip_model is not None:
            frames = np.concatenate([np.arange(window.start, window.end) for window in split.windows])
            embed.embed_frames(root, split, frames, clip_model, clip)
        _card(info, manifest, config.repo_id).save(root / "README.md")
    return config.output_dir


def _check_options(config: ConvertConfig) -> None:
    if config.action not in ("rel", "abs"):
        raise ValueError(f"--action={config.action}: expected rel or abs")
    if config.workers < 1:
        raise ValueError(f"--workers={config.workers}: expected 1 or more")
    if config.push_to_hub and config.repo_id.count("/") != 1:
        raise ValueError(f"--repo_id={config.repo_id}: expected user/name to push to the hub")


def _is_done(output_dir: Path, request: dict[str, Any]) -> bool:
    if not output_dir.exists() or (output_dir.is_dir() and not any(output_dir.iterdir())):
        return False
    manifest = output_dir / MANIFEST
    if manifest.is_file() and json.loads(manifest.read_text())["request"] == request:
        return True
    what = "the result of another conversion" if manifest.is_file() else "something else"
    raise ValueError(f"--output_dir={output_dir} holds {what}: remove it or choose another folder")


def _run(job: _Job, workers: int) -> list[dict]:
    """Writes all shards, with a progress bar over episodes; returns their statistics in order."""
    total = len(job.split.windows)
    shards = range(-(-total // EPISODES_PER_SHARD))
    with tqdm(total=total, desc="converting", unit="episode") as bar:
        if workers == 1:
            return [job.write(shard, bar.update) for shard in shards]
        # Forked workers need not import LeRobot again (20 s and 0.5 GB each).
        methods = multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("fork" if "fork" in methods else "spawn")
        done, stop = context.Value("q", 0), context.Event()
        with ProcessPoolExecutor(workers, context, _start_worker, (job, done, stop, os.getpid())) as pool:
            futures = [pool.submit(_write_in_worker, shard) for shard in shards]
            try:
                while wait(futures, timeout=0.5, return_when=FIRST_EXCEPTION).not_done:
                    bar.update(done.value - bar.n)
                    for future in futures:
                        if future.done():
                            future.result()
                bar.update(done.value - bar.n)
                return [future.result() for future in futures]
            except BaseException:
                stop.set()
                pool.shutdown(cancel_futures=True)  # nobody writes while the folder is removed
                raise


_worker: tuple[_Job, Any, Any] | None = None


def _start_worker(job: _Job, done: Any, stop: Any, parent: int) -> None:
    global _worker
    _worker = job, done, stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C

    def follow_parent() -> None:  # a killed parent must not leave writers behind
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()


def _write_in_worker(shard: int) -> dict:
    assert _worker is not None
    job, done, stop = _worker

    def count() -> None:
        if stop.is_set():
            raise RuntimeError("stopped because another worker failed")
        with done.get_lock():
            done.value += 1

    return job.write(shard, count)


def _card(info: Any, manifest: dict[str, Any], repo_id: str) -> Any:
    from lerobot.datasets.utils import create_lerobot_dataset_card

    return create_lerobot_dataset_card(dataset_info=info, repo_id=repo_id, **_card_fields(manifest, repo_id))


def _card_fields(manifest: dict[str, Any], repo_id: str) -> dict[str, Any]:
    return {
        "tags": ["calvin", "language-conditioned"],
        "license": None,
        "dataset_description": describe(manifest, repo_id),
        "url": "http://calvin.cs.uni-freiburg.de",
        "paper": "https://arxiv.org/abs/2112.03227",
    }


def push(config: ConvertConfig) -> None:
    """Uploads the converted dataset with LeRobot's own method, which also sets the tag that loading needs."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    manifest = json.loads((config.output_dir / MANIFEST).read_text())
    dataset = LeRobotDataset(config.repo_id, root=config.output_dir)
    dataset.push_to_hub(private=config.private, **_card_fields(manifest, config.repo_id))


def main() -> int:
    """Runs the command; returns 0, or 2 after an error the user can mend."""
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the encoder prints 20 lines per file otherwise
    try:
        config = draccus.parse(ConvertConfig)
        convert(config)
    except (OSError, ValueError, DraccusException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; nothing was left behind", file=sys.stderr)
        return 130
    if config.push_to_hub:
        try:
            push(config)
        except Exception as error:  # the network's errors are of many kinds, and the dataset is safe on disk
            print(
                f"error: cannot upload {config.output_dir}: {error}; run this again to retry", file=sys.stderr
            )
            return 2
    print(f"dataset {config.repo_id} is at {config.output_dir}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
