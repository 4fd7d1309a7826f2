"""`lansar-play`, by keys and through a window that nobody sees."""

from dataclasses import replace

import av
import numpy as np
import pytest

from dataset_convert.calvin import CalvinSplit
from lerobot_lansar.calvin import CAMERAS, relative_action
from lerobot_lansar.demos import teleop
from lerobot_lansar.desk import Desk, DeskError, SimulationError


def test_keys_press_the_button_and_the_video_shows_the_verdict(tmp_path, capsys):
    video = tmp_path / "seen.mp4"
    session = teleop.teleoperate(teleop.TeleopConfig(keys=teleop.DEMONSTRATION, video=video))
    assert set(session.fulfilled) == {"turn_on_led"}
    assert "fulfilled: turn_on_led" in capsys.readouterr().out
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    steps = sum(steps for _, steps in teleop.parse_keys(teleop.DEMONSTRATION))
    assert len(frames) == steps
    assert frames[0].shape == (600, 900, 3)
    verdict = np.array([110, 230, 120])
    near = [(np.abs(frame[300:, 600:].astype(int) - verdict).max(-1) < 60).sum() for frame in frames]
    assert near[0] == 0 < near[-1]
    assert [file.name for file in tmp_path.iterdir()] == ["seen.mp4"]


def test_enter_keeps_demonstrations_that_fulfil_a_task(tmp_path):
    press = "a8 w6 f7 wait4 r4"
    config = teleop.TeleopConfig(
        keys=f"wait enter {press} enter enter wait5 enter",
        output_dir=tmp_path / "mine",
        video=tmp_path / "v.mp4",
    )
    session = teleop.teleoperate(config)
    assert [window[2] for _, unit, _ in session.kept for window in unit.windows] == ["turn_on_led"]
    split = CalvinSplit(tmp_path / "mine", "training")
    (window,) = split.windows
    assert window.task == "turn_on_led"
    read = split.read(
        range(window.start, window.end), ["robot_obs", "scene_obs", "actions", "rel_actions", "rgb_static"]
    )
    assert read["rgb_static"].shape[1:] == (200, 200, 3)
    for robot_obs, action, relative in zip(read["robot_obs"], read["actions"], read["rel_actions"], strict=True):
        np.testing.assert_allclose(relative_action(action, robot_obs), relative)
    assert read["scene_obs"][0, 5] == 0
    assert read["scene_obs"][-1, 5] == 1
    assert not (tmp_path / "mine" / ".playing").exists()
    with pytest.raises(DeskError, match="already holds a recording"):
        teleop.teleoperate(config)


def test_a_demonstrations_last_frame_shows_its_task_fulfilled(tmp_path):
    session = teleop.Session(teleop.TeleopConfig(output_dir=tmp_path), Desk("D", None, CAMERAS))
    session.press("enter")
    held = [key for key, steps in teleop.parse_keys("a8 w6 f7 wait4 r4") for _ in range(steps)]
    while not session.fulfilled:
        key = held.pop(0)
        session.step(() if key == "wait" else (key,))
    session.press("enter")
    session.finish()
    split = CalvinSplit(tmp_path, "training")
    (window,) = split.windows
    led = split.read(range(window.start, window.end), ["scene_obs"])["scene_obs"][:, 5]
    assert led[-1] == 1
    assert not led[:-1].any()


def test_a_task_that_was_undone_is_not_kept(tmp_path, capsys):
    config = teleop.TeleopConfig(
        keys="enter a8 w6 f7 wait4 r4 f5 wait5 r4 enter",
        output_dir=tmp_path / "mine",
        video=tmp_path / "v.mp4",
    )
    session = teleop.teleoperate(config)
    assert not session.fulfilled
    assert not session.kept
    assert "the demonstration was dropped: no task is fulfilled" in capsys.readouterr().err
    assert not (tmp_path / "mine" / "training").exists()


def test_what_was_kept_survives_a_session_that_fails(tmp_path, monkeypatch):
    begin = teleop.Session.begin

    def fails(session):
        if session.kept:
            raise SimulationError("diverged")
        begin(session)

    monkeypatch.setattr(teleop.Session, "begin", fails)
    with pytest.raises(SimulationError):
        teleop.teleoperate(
            teleop.TeleopConfig(
                keys="enter a8 w6 f7 wait4 r4 enter backspace wait",
                output_dir=tmp_path / "mine",
                video=tmp_path / "v.mp4",
            )
        )
    assert len(CalvinSplit(tmp_path / "mine", "training").windows) == 1
    assert not (tmp_path / "v.mp4").exists()


def test_what_was_kept_survives_a_session_that_is_killed(tmp_path, monkeypatch, capsys):
    config = teleop.TeleopConfig(
        keys="enter a8 w6 f7 wait4 r4 enter", output_dir=tmp_path / "mine", video=tmp_path / "v.mp4"
    )
    with monkeypatch.context() as killed:
        killed.setattr(teleop.Session, "finish", lambda session: None)
        teleop.teleoperate(config)
    assert not (tmp_path / "mine" / "training").exists()
    with pytest.raises(ValueError, match="begun with other options"):
        teleop.teleoperate(replace(config, scene="A"))
    teleop.teleoperate(config)
    assert "1 demonstrations of a session that was killed are kept, too" in capsys.readouterr().err
    assert len(CalvinSplit(tmp_path / "mine", "training").windows) == 2


def test_the_window_takes_keys(monkeypatch, tmp_path):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = teleop.open_window()
    assert pygame is not None
    held = {pygame.K_d: 12}
    presses = [pygame.K_SPACE]

    class Held:
        def __getitem__(self, key):
            held[key] = held.get(key, 0) - 1
            return held[key] >= 0

    steps = 0

    def events():
        nonlocal steps
        steps += 1
        if presses and steps == 5:
            return [pygame.event.Event(pygame.KEYDOWN, key=presses.pop())]
        return [pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE)] if steps == 15 else []

    monkeypatch.setattr(pygame.key, "get_pressed", Held)
    monkeypatch.setattr(pygame.event, "get", events)
    monkeypatch.setattr(teleop, "open_window", lambda: pygame)
    config = teleop.TeleopConfig(task="open_drawer", seed=1, video=tmp_path / "v.mp4")
    with Desk("D") as desk:
        start = teleop.Session(config, desk).obs
    session = teleop.teleoperate(config)
    assert session.steps == 14
    assert session.obs["robot_obs"][0] - start["robot_obs"][0] > 0.1
    assert session.obs["robot_obs"][14] == -start["robot_obs"][14]


def test_without_a_display_keys_are_played(monkeypatch, tmp_path, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(teleop.sys, "platform", "linux")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(teleop, "DEMONSTRATION", "wait2")
    teleop.teleoperate(teleop.TeleopConfig())
    assert (tmp_path / "play.mp4").is_file()
    assert "no window without a display" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keys": "d5 jump"}, r"--keys: 'jump' is none of"),
        ({"task": "fly"}, r"--task=fly is unknown"),
    ],
)
def test_errors_name_the_option(options, message):
    with pytest.raises(DeskError, match=message):
        teleop.teleoperate(teleop.TeleopConfig(**options))
