"""`lansar-play`: drive the gripper by keyboard, see the oracle's verdicts, record demonstrations of your own."""

import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from ..calvin import CAMERAS, CONTROL_HZ, GRIPPER_ACTION, POSE_UNITS, TASKS, TCP_POSE, relative_action, wrap_angle
from ..command import run_command
from ..desk import Desk, DeskError, Observation
from ..desk.sentences import load_commands
from ..desk.starts import sample_start
from ..jobs.staging import staging
from .calvin_folder import FrameWriter, Unit, publish_split
from .video import Video

MOVES = {
    "d": (0, 1.0),
    "a": (0, -1.0),
    "w": (1, 1.0),
    "s": (1, -1.0),
    "r": (2, 1.0),
    "f": (2, -1.0),
    "z": (3, 1.0),
    "x": (3, -1.0),
    "t": (4, 1.0),
    "g": (4, -1.0),
    "q": (5, 1.0),
    "e": (5, -1.0),
}
"""Key to axis (x, y, z, roll, pitch, yaw) and direction of a relative action."""
HELP = (
    "A D   left, right",
    "W S   back, front",
    "R F   up, down",
    "Q E   turn      T G, Z X   tilt",
    "SPACE   open or close the hand",
    "ENTER   judge from here; record",
    "BACKSPACE   new start     ESC   quit",
)
SIZE = 600
"""Width and height of the large picture, in pixels."""
STAGING = ".playing"
"""The folder in OUTPUT_DIR in which kept demonstrations wait."""
_NOTE = ".unit"  # extension of the files that describe them
DEMONSTRATION = "a8 w6 f7 wait4 r4 space wait10"
"""Keys pressed if there is neither a display nor `--keys`: the hand presses the LED's button and closes."""


@dataclass
class TeleopConfig:
    """Opens a desk for driving by keyboard; without a display, presses given keys and writes a video instead."""

    # A, B, C, D, or D_eval, calvin_env's fixed layout of D.
    scene: str = "D"
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # What draws the pictures: gl, tiny, pybullet_gl or pybullet_tiny.
    renderer: str = "gl"
    # Start in a random state in which this task is feasible; everything closed and off by default.
    task: str | None = None
    # Decides the first start state; BACKSPACE counts it up.
    seed: int = 0
    # Keep demonstrations here, in CALVIN's format: ENTER begins one, ENTER after a fulfilled task keeps it.
    output_dir: Path | None = None
    # Keys to press instead of a keyboard: 'd10 f5 space wait20 enter', a number for how many steps each is held.
    keys: str | None = None
    # Write what the person sees to this mp4; by default play.mp4 with --keys or without a display, else none.
    video: Path | None = None

    def check(self) -> None:
        """Raises DeskError for options that cannot be carried out."""
        if self.task is not None and self.task not in TASKS:
            raise DeskError(f"--task={self.task} is unknown; choose among: {', '.join(TASKS)}")
        if self.output_dir is not None and (self.output_dir / "training").exists():
            raise DeskError(f"--output_dir={self.output_dir} already holds a recording; choose another folder")
        if self.seed < 0:
            raise DeskError(f"--seed={self.seed}: expected 0 or more")
        list(parse_keys(self.keys or ""))


class Session:
    """A desk driven by keys, with the tasks fulfilled since the last mark.

    Args:
        config: The command's options.
        desk: With both cameras.
    """

    def __init__(self, config: TeleopConfig, desk: Desk):
        self.config, self.desk = config, desk
        self.kept: list[tuple[Path, Unit, list[str]]] = []
        self.recording = False
        self._commands = load_commands(None, "training")
        self._starts = config.seed
        self.begin()

    def begin(self) -> None:
        """Resets the desk to a new start state."""
        rng = np.random.default_rng(self._starts)
        if self.config.task is None:
            self.obs = self.desk.reset(seed=self._starts)
        else:
            self.obs = self.desk.reset(*sample_start(self.desk, self.config.task, rng))
        self._starts += 1
        self._target = self.obs["robot_obs"][TCP_POSE].copy()
        self._gripper = float(self.obs["robot_obs"][GRIPPER_ACTION])
        self.mark()
        self.recording = False

    def mark(self) -> None:
        """The oracle judges from here on, and a recording begins here."""
        self.fulfilled: dict[str, int] = {}
        self.steps = 0
        self._start = self.desk.snapshot()
        self._rows: list[dict[str, np.ndarray]] = []

    def press(self, key: str) -> None:
        """Handles a key that is pressed rather than held: space, enter or backspace."""
        if key == "space":
            self._gripper = -self._gripper
        elif key == "backspace":
            self.begin()
        elif key == "enter":
            if self.recording:
                self._end()
            self.recording = not self.recording and self.config.output_dir is not None
            self.mark()

    def step(self, held: Iterable[str] = ()) -> Observation:
        """Takes one control step with the given keys of `MOVES` held down."""
        pose = self.obs["robot_obs"][TCP_POSE]
        for key in held:
            axis, direction = MOVES[key]
            self._target[axis] = pose[axis] + direction * POSE_UNITS[axis]
        action = np.append(self._target, self._gripper)
        action[3:6] = wrap_angle(action[3:6])
        if self.recording:
            relative = relative_action(action, self.obs["robot_obs"])
            self._rows.append({**self.obs, "actions": action, "rel_actions": relative})
        self.steps += 1
        self.obs = self.desk.step(action, control_mode="abs")
        now = self.desk.completed_tasks(self._start)
        self.fulfilled = {task: self.fulfilled.get(task, self.steps) for task in sorted(now)}
        return self.obs

    def _end(self) -> None:
        """Keeps the demonstration under way if a task is fulfilled, with one more frame, which shows it."""
        if self.fulfilled:
            self.step()
        if self.fulfilled:
            assert self.config.output_dir is not None
            self._keep(self.config.output_dir)
        else:
            print("the demonstration was dropped: no task is fulfilled", file=sys.stderr)

    def _keep(self, output: Path) -> None:
        """Writes the recorded frames as one demonstration: of `--task` if it is fulfilled, else of the latest task."""
        asked = self.config.task
        task = asked if asked in self.fulfilled else max(self.fulfilled, key=lambda name: self.fulfilled[name])
        assert task is not None
        folder = output / STAGING / f"{len(self.kept):06d}"
        with FrameWriter(folder, self.desk.scene) as writer:
            for row in self._rows:
                writer.add(row)
        n = len(self._rows)
        unit = Unit(self.desk.scene.name, n, [(0, n)], [(0, n, task)], sums=writer.sums())
        unit.sentences = [self._commands[task][0]]
        unit.save(folder.with_suffix(_NOTE))
        self.kept.append((folder, unit, unit.sentences))

    def take_up(self) -> None:
        """Takes up what a session of the same options kept that was killed."""
        assert self.config.output_dir is not None
        for note in sorted((self.config.output_dir / STAGING).glob(f"*{_NOTE}")):
            unit = Unit.load(note)
            self.kept.append((note.with_suffix(""), unit, unit.sentences))
        if self.kept:
            print(f"{len(self.kept)} demonstrations of a session that was killed are kept, too", file=sys.stderr)

    def finish(self) -> None:
        """Publishes the kept demonstrations as OUTPUT_DIR/training; to be called however the session ended."""
        output = self.config.output_dir
        if output is None:
            return
        if self.recording:
            print("the demonstration under way was dropped: ENTER keeps one", file=sys.stderr)
        if self.kept:
            details: dict[str, str | int] = {key: str(value) for key, value in asdict(self.config).items()}
            details |= {"assets_used": self.desk.assets, "control_hz": CONTROL_HZ}
            publish_split(output / "training", self.kept, 0, details, {})
            print(f"{len(self.kept)} demonstrations in {output}")
        shutil.rmtree(output / STAGING, ignore_errors=True)

    def picture(self) -> np.ndarray:
        """What the person sees, (600, 900, 3) uint8: both cameras, verdicts and keys."""
        canvas = Image.new("RGB", (SIZE * 3 // 2, SIZE), (24, 26, 30))
        canvas.paste(Image.fromarray(self.desk.render("static", SIZE)), (0, 0))
        canvas.paste(Image.fromarray(self.desk.render("gripper", SIZE // 2)), (SIZE, 0))
        draw = ImageDraw.Draw(canvas)
        x, y = SIZE + 12, SIZE // 2 + 10
        if self.recording:
            draw.text((x, y), f"RECORDING, {self.steps} frames", (255, 90, 90), _font(15))
        else:
            draw.text((x, y), f"{self.steps / CONTROL_HZ:.1f} s", (200, 200, 200), _font(15))
        if self.kept:
            draw.text((x + 190, y), f"{len(self.kept)} kept", (200, 200, 200), _font(15))
        listed = sorted(self.fulfilled.items(), key=lambda item: -item[1])
        for line, (task, step) in enumerate(listed[:5]):
            draw.text((x, y + 26 + 22 * line), f"{task}  {step / CONTROL_HZ:.1f} s", (110, 230, 120), _font(15))
        if not listed:
            draw.text((x, y + 26), "nothing fulfilled yet", (140, 140, 140), _font(15))
        for line, text in enumerate(HELP):
            draw.text((x, SIZE - 18 * (len(HELP) - line) - 6), text, (150, 150, 150), _font(13))
        return np.asarray(canvas)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def parse_keys(text: str) -> Iterator[tuple[str, int]]:
    """Reads `'d10 space wait5'` as pairs of key and steps.

    Raises:
        DeskError: A word is not a key.
    """
    for word in text.split():
        match = re.fullmatch(r"([a-z]+?)(\d*)", word)
        if match is None or match[1] not in (*MOVES, "space", "enter", "backspace", "wait"):
            raise DeskError(
                f"--keys: {word!r} is none of {', '.join(MOVES)}, space, enter, backspace, wait, with a number of "
                "steps behind it"
            )
        yield match[1], int(match[2] or 1)


def press_keys(session: Session, keys: str, video: Video | None) -> None:
    """Presses the given keys one after the other, without a window."""
    for key, steps in tqdm(list(parse_keys(keys)), desc="playing", unit="key"):
        if key in ("space", "enter", "backspace"):
            session.press(key)
            steps, key = 1, "wait"
        for _ in range(steps):
            session.step(() if key == "wait" else (key,))
            if video is not None:
                video.add(session.picture())


def drive_in_window(session: Session, pygame: Any, video: Video | None) -> None:
    """Drives by keyboard until ESC is pressed or the window is closed."""
    window = pygame.display.set_mode((SIZE * 3 // 2, SIZE))
    pygame.display.set_caption(f"CALVIN desk, scene {session.desk.scene.name}")
    pressed = {pygame.K_SPACE: "space", pygame.K_RETURN: "enter", pygame.K_BACKSPACE: "backspace"}
    clock = pygame.time.Clock()
    while True:
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                return
            if event.type == pygame.KEYDOWN and event.key in pressed:
                session.press(pressed[event.key])
        state = pygame.key.get_pressed()
        session.step([key for key in MOVES if state[pygame.key.key_code(key)]])
        picture = session.picture()
        window.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        if video is not None:
            video.add(picture)
        clock.tick(CONTROL_HZ)


def open_window() -> Any | None:
    """The module pygame if it finds a display; else None, and the reason is printed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError:
        print("no window without pygame: pip install 'lerobot_policy_lansar[play]'", file=sys.stderr)
        return None
    asked = os.environ.get("SDL_VIDEODRIVER")
    if sys.platform == "linux" and not asked and not ({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)):
        print("no window without a display: playing keys into a video", file=sys.stderr)
        return None
    try:
        pygame.display.init()
    except pygame.error as error:
        print(f"no window ({error}): playing keys into a video", file=sys.stderr)
        return None
    return pygame


def _keeping(config: TeleopConfig) -> AbstractContextManager[None]:
    """Makes the place where kept demonstrations wait, for one session at a time."""
    if config.output_dir is None:
        return nullcontext()
    request = {"scene": config.scene, "assets": config.assets, "renderer": config.renderer}
    folder, target = config.output_dir / STAGING, config.output_dir / "training"
    return staging(folder, target, request, lambda place: any(place.glob(f"*{_NOTE}")))


def teleoperate(config: TeleopConfig) -> Session:
    """Runs a session to its end and returns it.

    Raises:
        DeskError: An option cannot be carried out.
        ValueError: Another session is keeping demonstrations there, or one with other options did and was killed.
    """
    config.check()
    pygame = open_window() if config.keys is None else None
    path = config.video
    if path is None and pygame is None:
        path = Path("play.mp4")
    cameras = () if config.output_dir is None else tuple(CAMERAS)  # pictures are recorded, or else only shown
    with Desk(config.scene, config.assets, cameras, config.renderer) as desk:
        session = Session(config, desk)
        recorder: AbstractContextManager[Video | None] = Video(path) if path else nullcontext()
        with _keeping(config):
            if config.output_dir is not None:
                session.take_up()
            try:
                with recorder as video:
                    if pygame is None:
                        press_keys(session, config.keys or DEMONSTRATION, video)
                    else:
                        drive_in_window(session, pygame, video)
                        pygame.quit()
            finally:
                session.finish()
        print(f"fulfilled: {', '.join(session.fulfilled) or 'nothing'}")
    return session


@draccus.wrap()
def run(config: TeleopConfig) -> None:
    """Runs a session."""
    teleoperate(config)


def main() -> int:
    """Entry point of `lansar-play`."""
    return run_command("lansar-play", run)


if __name__ == "__main__":
    sys.exit(main())
