"""Trains lansar-desk, the small CLIP that comes with the package, on pictures of the desks and on commands.

    python scripts/train_clip.py record --assets=CALVIN_ENV/data    # pictures of all four desks
    python scripts/train_clip.py train --output=FILE                # by default, the package's own weights
    python scripts/train_clip.py judge --sentences='[FILE.yaml]'    # what it understands and sees, on held-out data

Four losses, summed:

    pictures and captions   open_clip's own contrastive loss; captions say what is where (`caption`)
    commands                the same loss between two sentences for each of the 34 tasks (clip_grammar.yaml)
    states                  a linear head on the picture's embedding predicts what the caption says in numbers (smooth
                            L1); it is dropped afterwards, and makes that linear policies find the state
    places                  the first four features of the image encoder lie where the picture shows the three blocks
                            and the TCP (cross-entropy over the cells), which teaches it to look far sooner

With --text=FILE the text encoder is that file's and stays as it is, so sentences keep their embeddings, and policies
that were trained on them can go on. Without it every such policy loses its meaning, checkpoints/desk-d too. `record`
continues an interrupted recording; one round of all desks and assets in ten is held out, which is of play.
"""

import itertools
import multiprocessing
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
import torch.nn.functional as F
import yaml
from accelerate.utils import send_to_device
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from lerobot_lansar.calvin import (
    BULB,
    CAMERAS,
    COLORS,
    DRAWER,
    GRIPPER_WIDTH,
    LED,
    SCENE_NAMES,
    SLIDE,
    SLIDE_TRAVEL,
    TASKS,
    Task,
    block_pose,
)
from lerobot_lansar.cameras import gripper_camera_pose, intrinsics, static_camera_pose
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import CLIP_MODELS, Clip
from lerobot_lansar.demos.demonstrator import carry_out
from lerobot_lansar.demos.play import choose_task, feasible_tasks
from lerobot_lansar.demos.skills import SKILLS
from lerobot_lansar.desk import Desk, SimulationError, is_fulfilled
from lerobot_lansar.desk.oracle import DRAWER as IN_DRAWER
from lerobot_lansar.desk.oracle import PLANK, TABLE
from lerobot_lansar.desk.sentences import COMMANDS, load_commands
from lerobot_lansar.desk.starts import sample_start

MODEL = "lansar-desk"
GRAMMAR = Path(__file__).with_name("clip_grammar.yaml")
MOMENTS = 400
"""Moments of a session; a file each."""
ROUND = 2 * len(SCENE_NAMES)
"""Sessions in which each desk is shown once with each kind of assets."""
EVERY = 10
"""Control steps between moments."""
NEAR = 0.15
"""A block so near to the TCP (m) is described in the gripper camera's caption, and its position predicted."""
PLACES = ("elsewhere", "on the table", "in the cabinet", "in the drawer", "in the hand", "on another block")


@dataclass
class Options:
    """Of all three commands."""

    # Pictures are recorded here.
    root: Path = Path("data/clip")
    # The `data` folder of a calvin_env checkout: half of the sessions show it. None: only the built-in desks.
    assets: str | None = None
    # Sessions of 400 moments, two pictures each; the four desks in turn.
    sessions: int = 120
    # Processes that record, or that prepare batches beside the one that trains.
    workers: int = 2
    # Updates.
    steps: int = 3000
    # Pictures of each camera in an update.
    batch_size: int = 96
    learning_rate: float = 1e-3
    # Of `train`; recordings and what `judge` fits on are always the same.
    seed: int = 0
    # Where `train` and `judge` compute.
    device: str = "cpu"
    # A weights file whose text encoder is kept. None: both encoders are trained.
    text: Path | None = None
    # YAML files of sentences by task (CALVIN's form) that `judge` assigns to tasks.
    sentences: list[Path] = field(default_factory=list)
    # Where `train` writes the weights, and `judge` reads them.
    output: Path = CLIP_MODELS / f"{MODEL}-v1.safetensors"


# ---- moments


def record(options: Options) -> None:
    """Keeps pictures as the CLIP sees them, states and places: half of the rounds of play, half of random states."""
    options.root.mkdir(parents=True, exist_ok=True)
    jobs = [(number, options) for number in range(options.sessions) if not _session(options, number).exists()]
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for _ in tqdm(pool.imap_unordered(_record_session, jobs), total=len(jobs), unit="session"):
            pass


def _session(options: Options, number: int) -> Path:
    return options.root / f"session_{number:04d}.npz"


def _record_session(job: tuple[int, Options]) -> None:
    number, options = job
    torch.set_num_threads(1)
    rng = np.random.default_rng([11, number])
    scene = SCENE_NAMES[number % len(SCENE_NAMES)]
    assets = options.assets if number // len(SCENE_NAMES) % 2 else None
    clip = Clip(ClipConfig(MODEL, ""))
    rows: dict[str, list[np.ndarray]] = {}
    with Desk(scene, assets, cameras=()) as desk:
        moments = _scattered(desk, rng) if number // ROUND % 2 else _play(desk, rng)
        for obs, snapshot in itertools.islice(moments, MOMENTS):
            row = {
                **{camera: _as_seen(clip, desk.render(camera)) for camera in CAMERAS},
                "robot_obs": obs["robot_obs"],
                "scene_obs": obs["scene_obs"],
                "places": np.array([_place(snapshot.blocks[color]) for color in COLORS]),
            }
            for key, value in row.items():
                rows.setdefault(key, []).append(value)
    file = _session(options, number)
    partial = file.with_suffix(".partial.npz")
    np.savez(partial, scene=scene, assets=assets is not None, **{key: np.stack(row) for key, row in rows.items()})
    partial.rename(file)


def _as_seen(clip: Clip, picture: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 -> (S, S, 3) uint8, at the size at which the CLIP sees it."""
    return (255 * clip.images.resize(picture[None])[0]).round().byte().permute(1, 2, 0).numpy()


def _play(desk: Desk, rng: np.random.Generator):
    """Moments of endless play: five tasks, then a new random state."""
    while True:
        try:
            obs = desk.reset(*sample_start(desk, str(rng.choice(list(TASKS))), rng))
            last, before, count = desk.snapshot(), None, 0
            yield obs, last
            for _ in range(5):
                feasible = feasible_tasks(desk.scene, last, obs, before)
                if not feasible:
                    break
                before = choose_task(feasible, before, rng, {})
                start, done = last, 0
                for _, obs, last in carry_out(desk, obs, SKILLS[before], rng, noise=0.4):  # noqa: B020
                    count += 1
                    if count % EVERY == 0:
                        yield obs, last
                    done = done + 1 if is_fulfilled(before, start, last) else 0
                    if done > 2:
                        break
        except SimulationError:
            continue


def _scattered(desk: Desk, rng: np.random.Generator):
    """Random states, each also with the hand near two of its blocks. In play, blocks lie where they are for long."""
    while True:
        try:
            robot, scene = sample_start(desk, str(rng.choice(list(TASKS))), rng)
            yield desk.reset(robot, scene), desk.snapshot()
            for k in rng.permutation(len(COLORS))[:2]:
                position = scene[block_pose(k)][:3] + rng.normal(0, 0.04, 3) + [0, 0, 0.08]
                euler = np.array([np.pi, 0, 0]) + rng.normal(0, 0.1, 3) + [0, 0, np.pi / 2 + rng.uniform(-0.8, 0.8)]
                joints = desk.solve_ik(position, euler)
                obs = desk.reset(np.array([*position, *euler, robot[GRIPPER_WIDTH], *joints, robot[-1]]), scene)
                if np.linalg.norm(obs["robot_obs"][:3] - position) < 0.02:
                    yield obs, desk.snapshot()
        except SimulationError:
            continue


def _place(block) -> int:
    if "robot" in block.bodies:
        return 4
    if block.bodies & set(COLORS):
        return 5
    return next((n for n, part in ((1, TABLE), (2, PLANK), (3, IN_DRAWER)) if part in block.contacts), 0)


# ---- what pictures show, in words and numbers


def _grid(position: np.ndarray) -> str:
    """A place on the desk in words: columns and rows of 2 cm, from the left and from the front."""
    return f"column {round((position[0] + 0.5) / 0.02)} row {round((position[1] + 0.45) / 0.02)}"


def caption(moment: dict[str, np.ndarray], camera: str, rng: np.random.Generator) -> str:
    """What a camera sees, as a random selection of facts in random order.

    Args:
        moment: A row of the recorded arrays, and `scene`.
        camera: `static` or `gripper`.
        rng: The only source of randomness.
    """
    robot, scene = moment["robot_obs"], moment["scene_obs"]
    tcp = robot[:3]
    opened = "open" if robot[GRIPPER_WIDTH] > 0.06 else "closed"
    facts = [f"hand {opened} {_grid(tcp)} height {round((tcp[2] - 0.3) / 0.02)}"]
    if camera == "static":
        facts += [
            f"{c} block {PLACES[moment['places'][k]]} {_grid(scene[block_pose(k)])}" for k, c in enumerate(COLORS)
        ]
        share = scene[SLIDE] / SLIDE_TRAVEL[str(moment["scene"])]
        facts += [f"drawer {_third(scene[DRAWER] / 0.22, 'closed', 'half open', 'open')}"]
        facts += [f"door {_third(share, 'right', 'middle', 'left')}"]
        facts += [f"bulb {'on' if scene[BULB] else 'off'}", f"led {'on' if scene[LED] else 'off'}"]
    else:
        for k, color in enumerate(COLORS):
            if moment["places"][k] == 4:
                facts.append(f"holding the {color} block")
            way = _from_camera(robot, scene[block_pose(k)][:3]) - _from_camera(robot, tcp)
            if np.linalg.norm(way) < NEAR:
                x, y, z = (round(100 * w) for w in way)
                sides = f"{'right' if x > 0 else 'left'} {abs(x)} {'below' if y > 0 else 'above'} {abs(y)}"
                facts.append(f"{color} block {sides} {'beyond' if z > 0 else 'before'} {abs(z)}")
    keep = [fact for fact in facts if rng.uniform() < 0.85] or facts
    return ", ".join(keep[k] for k in rng.permutation(len(keep)))


def _third(share: float, low: str, middle: str, high: str) -> str:
    return low if share < 0.2 else high if share > 0.8 else middle


def _from_camera(robot_obs: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point (3,) of the world in the gripper camera's coordinates, m."""
    return (np.linalg.inv(gripper_camera_pose(robot_obs)) @ [*point, 1.0])[:3]


def numbers(moment: dict[str, np.ndarray], camera: str) -> tuple[np.ndarray, np.ndarray]:
    """The state that a picture is to show, and which of its numbers it does show: (16,) each.

    static: TCP xyz, blocks xyz (m); slide, drawer (m), bulb, led.
    gripper: TCP xyz; blocks from the TCP in the camera's coordinates where they are near; gripper width, 3 unused.
    """
    robot, scene = moment["robot_obs"], moment["scene_obs"]
    blocks = np.stack([scene[block_pose(k)][:3] for k in range(len(COLORS))])
    shown = np.ones(16)
    if camera == "static":
        values = [*robot[:3], *blocks.ravel(), scene[SLIDE], scene[DRAWER], scene[BULB], scene[LED]]
        return np.array(values), shown
    pose = np.linalg.inv(gripper_camera_pose(robot))
    ways = blocks @ pose[:3, :3].T - robot[:3] @ pose[:3, :3].T
    shown[3:12] = np.repeat(np.linalg.norm(ways, axis=1) < NEAR, 3)
    shown[13:] = 0
    return np.array([*robot[:3], *ways.ravel(), robot[GRIPPER_WIDTH], 0.0, 0.0, 0.0]), shown


def pixels(moment: dict[str, np.ndarray], camera: str, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a camera's picture of `size` pixels shows the blocks and the TCP.

    Returns:
        Column and row of each, (4, 2), and which of them lie in the picture, (4,); some of these may be hidden.
    """
    robot, scene = moment["robot_obs"], moment["scene_obs"]
    points = np.stack([*(scene[block_pose(k)][:3] for k in range(len(COLORS))), robot[:3]])
    pose = np.linalg.inv(static_camera_pose() if camera == "static" else gripper_camera_pose(robot))
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    found = seen @ intrinsics(camera, size).T
    found = found[:, :2] / np.maximum(found[:, 2:], 1e-6)
    return found, (seen[:, 2] > 0.01) & (found >= 0).all(axis=1) & (found <= size - 1).all(axis=1)


UNITS = {
    "static": np.array([0.2, 0.15, 0.08] + [0.2, 0.15, 0.08] * 3 + [0.1, 0.08, 0.5, 0.5]),
    "gripper": np.array([0.2, 0.15, 0.08] + [0.04] * 9 + [0.03, 1.0, 1.0, 1.0]),
}
"""Camera to the size of its numbers: what an error of one means."""


# ---- commands


class Commands:
    """Draws sentences for each task from the grammar, but none of those that are held out."""

    def __init__(self) -> None:
        grammar = yaml.safe_load(GRAMMAR.read_text())
        self._words, self._tasks = grammar["words"], grammar["tasks"]
        self._held_out = {sentence for sentences in COMMANDS["validation"].values() for sentence in sentences}

    def draw(self, task: Task, rng: np.random.Generator) -> str:
        """A random sentence: of the grammar, or now and then one of the task's own training sentences."""
        if rng.uniform() < 0.15:
            return str(rng.choice(COMMANDS["training"][task.name]))
        patterns = self._tasks.get(task.name) or self._tasks.get(f"{task.kind}_{task.place}") or self._tasks[task.kind]
        while True:
            sentence = self._fill(str(rng.choice(patterns)), task, rng)
            if sentence not in self._held_out:
                return sentence

    def _fill(self, pattern: str, task: Task, rng: np.random.Generator) -> str:
        for _ in range(3):  # words may hold words
            for name, choices in self._words.items():
                while f"{{{name}}}" in pattern:
                    pattern = pattern.replace(f"{{{name}}}", choices, 1)
        pattern = pattern.replace("{color}", str(task.color)).replace("{side}", str(task.side))
        while "(" in pattern:  # the innermost first
            end = pattern.index(")")
            begin = pattern.rindex("(", 0, end)
            choice = str(rng.choice(pattern[begin + 1 : end].split("|")))
            pattern = pattern[:begin] + choice + pattern[end + 1 :]
        return " ".join(pattern.split())


# ---- training


class Data:
    """All recorded sessions of one split in memory."""

    def __init__(self, options: Options, held_out: bool):
        files = [f for f in sorted(options.root.glob("session_*.npz")) if "partial" not in f.name]
        files = [file for file in files if (int(file.stem[-4:]) // ROUND % 10 == 0) == held_out]
        if not files:
            which = f"no session of a round that is {'held out' if held_out else 'learned'}"
            raise SystemExit(
                f"{options.root} holds {which}: run `python scripts/train_clip.py record` with more than {ROUND} "
                "--sessions first"
            )
        parts = [dict(np.load(file)) for file in tqdm(files, desc="reading", unit="session")]
        keys = ("static", "gripper", "robot_obs", "scene_obs", "places")
        self.arrays = {key: np.concatenate([part[key] for part in parts]) for key in keys}
        self.arrays["scene"] = np.concatenate([np.full(len(part["static"]), str(part["scene"])) for part in parts])
        self.arrays["assets"] = np.concatenate([np.full(len(part["static"]), bool(part["assets"])) for part in parts])

    def __len__(self) -> int:
        return len(self.arrays["static"])

    def moment(self, index: int) -> dict[str, np.ndarray]:
        """One row of every array but the pictures."""
        return {key: self.arrays[key][index] for key in ("robot_obs", "scene_obs", "places", "scene")}


class Batches(Dataset):
    """One batch of each camera per update. Each has a random generator of its own, so `workers` changes nothing.

    A batch is {camera: tensors}, B of them: `pictures` (B, 3, S, S) uint8, their captions' `tokens` (B, L), the
    `values` (B, 16) of their state in units and which are `shown` (B, 16), `where` the picture shows things (B, 4, 2)
    in pixels and which are `visible` (B, 4); and without --text {"commands": tokens (2, 34, L)}.
    """

    def __init__(self, data: Data, tokenizer: Any, options: Options) -> None:
        self._data, self._tokenizer, self._options, self._commands = data, tokenizer, options, Commands()

    def __len__(self) -> int:
        return self._options.steps

    def __getitem__(self, step: int) -> dict[str, Any]:
        rng = np.random.default_rng([self._options.seed, step])
        batch: dict[str, Any] = {camera: self._camera(camera, rng) for camera in UNITS}
        if not self._options.text:
            sentences = [self._commands.draw(task, rng) for _ in range(2) for task in TASKS.values()]
            batch["commands"] = self._tokenizer(sentences).unflatten(0, (2, -1))
        return batch

    def _camera(self, camera: str, rng: np.random.Generator) -> dict[str, Tensor]:
        rows = np.sort(rng.choice(len(self._data), self._options.batch_size, replace=False))
        pictures = torch.from_numpy(self._data.arrays[camera][rows]).permute(0, 3, 1, 2)
        moments = [self._data.moment(row) for row in rows]
        values, shown = _stacked(numbers(moment, camera) for moment in moments)
        where, visible = _stacked(pixels(moment, camera, pictures.shape[-1]) for moment in moments)
        return {
            "pictures": pictures,
            "tokens": self._tokenizer([caption(moment, camera, rng) for moment in moments]),
            "values": (values - torch.from_numpy(CENTRES[camera])).div(torch.from_numpy(UNITS[camera])).float(),
            "shown": shown.float(),
            "where": where.float(),
            "visible": visible.float(),
        }


def _stacked(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(np.stack(part)) for part in zip(*pairs, strict=True))


def _augment(pictures: Tensor) -> Tensor:
    """Other saturation, contrast, light and tint, and noise: (B, 3, S, S) in [0, 1]."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(len(pictures), *shape, device=pictures.device)

    saturation, contrast = uniform(0.6, 1.4, 1, 1), uniform(0.7, 1.3, 1, 1)
    mix = saturation * torch.eye(3, device=pictures.device) + (1 - saturation) / 3  # of the colours, (B, 3, 3)
    tint, light = uniform(0.85, 1.15, 3, 1), uniform(-0.1, 0.1, 1, 1)
    offset = tint * (0.5 - 0.5 * contrast) + light
    mixed = torch.baddbmm(offset, tint * contrast * mix, pictures.flatten(2)).view_as(pictures)
    return mixed.add_(torch.randn_like(mixed), alpha=0.02).clamp_(0, 1)


def _around(where: Tensor, cells: int) -> Tensor:
    """Shares of a square's cells that lie about places (B, P, 2), column and row in cells: (B, P, cells * cells)."""
    middles = torch.arange(cells, device=where.device)  # a cell's middle is that of the pixel where its strides begin
    columns, rows = (torch.exp(-((where[..., None, k] - middles) ** 2) / (2 * 0.8**2)) for k in range(2))
    shares = (rows[..., :, None] * columns[..., None, :]).flatten(2)
    return shares / shares.sum(dim=-1, keepdim=True).clamp(min=1e-6)


def train(options: Options) -> None:
    """Trains the encoders and writes the weights in float16."""
    from open_clip import ClipLoss

    torch.manual_seed(options.seed)
    data = Data(options, held_out=False)
    clip = Clip(ClipConfig(MODEL, ""), options.device)
    model = clip.model.train().requires_grad_(True)
    if options.text:
        kept = {n: v for n, v in load_file(options.text).items() if not n.startswith("visual.") and n != "logit_scale"}
        model.load_state_dict(kept, strict=False)
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name not in kept)
    heads = nn.ModuleDict({camera: nn.Linear(clip.embed_dim, 16) for camera in UNITS}).to(options.device)
    weights = [w for w in (*model.parameters(), *heads.parameters()) if w.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=options.learning_rate, weight_decay=0.05, betas=(0.95, 0.98))
    # It also moves the first beta, between 0.95 and 0.85.
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, options.learning_rate, options.steps, pct_start=0.05)
    contrast = ClipLoss()
    encoder, scores = model.visual.trunk, {}
    encoder.maps.register_forward_hook(lambda module, given, found: scores.update(last=found))

    def read(tokens: Tensor) -> Tensor:
        return F.normalize(model.encode_text(tokens), dim=-1)

    def losses(batch: dict[str, Any]) -> Iterator[tuple[str, Tensor]]:
        scale = model.logit_scale.exp().clamp(max=100)
        for camera in UNITS:
            of = batch[camera]
            pictures = _augment(of["pictures"].float() / 255).contiguous(memory_format=torch.channels_last)
            seen = model.encode_image(clip.images.normalize(pictures))
            yield f"{camera} captions", contrast(F.normalize(seen, dim=-1), read(of["tokens"]), scale)
            error = F.smooth_l1_loss(heads[camera](seen), of["values"], reduction="none", beta=0.1)
            yield f"{camera} states", 3 * (error * of["shown"]).sum() / of["shown"].sum()
            cells = scores["last"].shape[-1]
            wanted = _around(of["where"] * cells / pictures.shape[-1], cells)
            error = -(wanted * encoder.log_shares(scores["last"])[:, : wanted.shape[1]]).sum(dim=-1)
            yield f"{camera} places", 0.3 * (error * of["visible"]).sum() / of["visible"].sum()
        if not options.text:
            yield "commands", contrast(*(read(tokens) for tokens in batch["commands"]), scale)

    means: dict[str, float] = {}
    batches = DataLoader(Batches(data, clip.tokenizer, options), batch_size=None, num_workers=options.workers)
    with tqdm(batches, unit="update") as bar:
        for step, batch in enumerate(bar):
            found = dict(losses(send_to_device(batch, clip.device)))
            optimizer.zero_grad(set_to_none=True)
            torch.stack(list(found.values())).sum().backward()
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimizer.step()
            schedule.step()
            if step % 20 == 0:
                for name, loss in found.items():
                    means[name] = 0.7 * means.get(name, loss.item()) + 0.3 * loss.item()
                bar.set_postfix({name: f"{mean:.3f}" for name, mean in means.items()})
    state = {name: value.detach().half().cpu().contiguous() for name, value in model.state_dict().items()}
    made = {name: str(getattr(options, name)) for name in ("steps", "batch_size", "learning_rate", "seed")}
    made |= {"trained_by": "scripts/train_clip.py", "moments": str(len(data))}
    partial = options.output.with_suffix(".partial")
    save_file(state, partial, made)
    partial.rename(options.output)
    print(f"{options.output}: {options.output.stat().st_size / 1e6:.1f} MB; losses {means}")


CENTRES = {
    "static": np.array([0.05, -0.1, 0.5] + [0.05, -0.05, 0.45] * 3 + [0.14, 0.11, 0.5, 0.5]),
    "gripper": np.array([0.05, -0.1, 0.5] + [0.0] * 9 + [0.04, 0.0, 0.0, 0.0]),
}


# ---- judging


def judge(options: Options) -> None:
    """Prints how many held-out sentences are nearest to their own task, and what linear probes read from pictures."""
    clip = Clip(ClipConfig(MODEL, str(options.output)), options.device)
    _judge_sentences(clip, options)
    _judge_pictures(clip, options)


def _judge_sentences(clip: Clip, options: Options) -> None:
    def embed(sentences: list[str]) -> Tensor:
        return F.normalize(clip.encode_texts(sentences), dim=-1)

    tasks = list(TASKS)
    centres = torch.stack([F.normalize(embed(COMMANDS["training"][task]).mean(0), dim=0) for task in tasks])
    print("\n| sentences | nearest to their own task |\n| --- | ---: |")
    sets = {"the grammar's held-out ones": COMMANDS["validation"]}
    sets |= {str(file): load_commands(file, "validation") for file in options.sentences}
    missed = []
    for name, sentences in sets.items():
        pairs = [(task, sentence) for task in tasks for sentence in sentences[task]]
        found = (embed([sentence for _, sentence in pairs]) @ centres.T).argmax(1).tolist()
        right = [tasks[k] == task for k, (task, _) in zip(found, pairs, strict=True)]
        missed += [(s, t, tasks[k]) for k, (t, s), ok in zip(found, pairs, right, strict=True) if not ok]
        print(f"| {name} | {sum(right)} of {len(right)} ({100 * np.mean(right):.1f} %) |")
    for sentence, task, taken in missed:
        print(f"    {sentence!r} ({task}) is taken for {taken}")


def _judge_pictures(clip: Clip, options: Options) -> None:
    fitted, judged = Data(options, held_out=False), Data(options, held_out=True)
    few = np.random.default_rng(0).choice(len(fitted), min(len(fitted), 12_000), replace=False)
    print(
        "\n| desk | camera | block position, median (mm) | of those on the table | drawer | slide | bulb | led |\n"
        "| --- | --- |" + " ---: |" * 6
    )
    for camera in UNITS:
        x, y = _embedded(clip, fitted, camera, few), _embedded(clip, judged, camera, np.arange(len(judged)))
        truth = [
            np.stack([numbers(d.moment(i), camera) for i in rows])
            for d, rows in ((fitted, few), (judged, range(len(judged))))
        ]
        found = _probe(x, truth[0], y)
        for scene, original in itertools.product(SCENE_NAMES, (False, True)):
            rows = (judged.arrays["scene"] == scene) & (judged.arrays["assets"] == original)
            if rows.any():
                on_table = judged.arrays["places"][rows] == PLACES.index("on the table")
                name = f"{scene}{', original assets' if original else ''}"
                print(_line(name, camera, found[rows], truth[1][rows], on_table))


def _embedded(clip: Clip, data: Data, camera: str, rows: np.ndarray) -> np.ndarray:
    parts = np.array_split(rows, max(1, len(rows) // 256))
    return np.concatenate([clip.encode_images(data.arrays[camera][part]).cpu().numpy() for part in parts])


def _probe(x: np.ndarray, truth: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Ridge regression of each number on the embedding, from the moments that show it; its values at `y`."""
    mean, std = x.mean(0), x.std(0) + 1e-6
    x, y = (np.c_[(part - mean) / std, np.ones(len(part))] for part in (x, y))
    found = []
    for values, shown in zip(truth[:, 0].T, truth[:, 1].T, strict=True):
        a, b = x[shown > 0], values[shown > 0]
        found.append(y @ np.linalg.solve(a.T @ a + 3.0 * np.eye(a.shape[1]), a.T @ b) if len(a) else np.zeros(len(y)))
    return np.stack(found, axis=1)


def _line(name: str, camera: str, found: np.ndarray, truth: np.ndarray, on_table: np.ndarray) -> str:
    values, shown = truth[:, 0], truth[:, 1]
    errors = np.linalg.norm((found - values)[:, 3:12].reshape(-1, 3, 3), axis=2)
    visible = shown[:, 3:12:3] > 0
    if camera == "gripper":
        visible &= np.linalg.norm(values[:, 3:12].reshape(-1, 3, 3), axis=2) < 0.1
    cells = [f"{1000 * np.median(errors[blocks]):.0f}" for blocks in (visible, visible & on_table)]
    if camera == "static":
        for column, middle in ((13, 0.11), (12, None), (14, 0.5), (15, 0.5)):
            middle = SLIDE_TRAVEL[name[0]] / 2 if middle is None else middle
            sure = np.abs(values[:, column] - middle) > 0.2 * middle
            right = (found[:, column] > middle) == (values[:, column] > middle)
            cells.append(f"{100 * right[sure].mean():.1f} %")
    return f"| {name} | {camera} | " + " | ".join([*cells, *[""] * (6 - len(cells))]) + " |"


def main() -> None:
    """Runs the named command."""
    commands = {"record": record, "train": train, "judge": judge}
    if len(sys.argv) < 2 or sys.argv[1] not in commands:
        raise SystemExit(f"python scripts/train_clip.py {'|'.join(commands)} [options]")
    commands[sys.argv[1]](draccus.parse(Options, args=sys.argv[2:]))


if __name__ == "__main__":
    main()
