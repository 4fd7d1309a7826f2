"""Demonstrations of all 34 tasks: they succeed, keep CALVIN's relations, can be replayed, and move like a hand."""

import os
from functools import cache, partial

import numpy as np
import pytest

from lerobot_lansar.calvin import (
    COLORS,
    DRAWER,
    GRIPPER_ACTION,
    GRIPPER_WIDTH,
    LED,
    SLIDE,
    STEPS_PER_COMMAND,
    TASKS,
    block_pose,
    relative_action,
)
from lerobot_lansar.demos.demonstrator import carry_out, demonstrate, fulfil
from lerobot_lansar.demos.interrupted import finishes, interrupt
from lerobot_lansar.demos.motion import TOP_SPEED, Disturbance
from lerobot_lansar.demos.skills import SKILLS
from lerobot_lansar.desk import SCENES, Desk, DeskError, SimulationError, is_fulfilled
from lerobot_lansar.desk.scenes import TABLE_Z
from lerobot_lansar.desk.starts import sample_start
from lerobot_lansar.jobs.pool import in_processes

STARTS, NEEDED, IN_A_ROW = 20, 18, 6
PROCESSES = max(1, (os.cpu_count() or 1) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def test_there_is_a_skill_for_every_task():
    assert set(SKILLS) == set(TASKS)


def test_unknown_tasks_are_refused():
    with Desk("D", cameras=()) as desk, pytest.raises(DeskError, match="task 'juggle' is unknown"):
        demonstrate(desk, "juggle", np.random.default_rng(0))


@cache
def desk_of(scene, assets=None):
    """One desk a process and scene; a reset leaves nothing of the episode before."""
    return Desk(scene, assets, cameras=())


def successes(job):
    """How many of how many seeded random starts end in success.

    Counted until `NEEDED` are reached or out of reach, or all of the first `IN_A_ROW` are successes.
    """
    scene, assets, task = job
    count = tried = 0
    desk = desk_of(scene, assets)
    while count < NEEDED and tried - count <= STARTS - NEEDED and not count == tried == IN_A_ROW:
        tried += 1
        try:
            count += demonstrate(desk, task, np.random.default_rng([9, tried - 1])) is not None
        except SimulationError:
            continue
    return count, tried


def failing(scene, assets=None):
    jobs = [(scene, assets, task) for task in TASKS]
    found = zip(TASKS, in_processes(successes, jobs, PROCESSES, ordered=True), strict=True)
    return {task: (count, tried) for task, (count, tried) in found if count < min(tried, NEEDED)}


@pytest.mark.slow
@pytest.mark.timeout(2400)
@pytest.mark.parametrize("scene", SCENES)
def test_every_task_succeeds_from_nine_of_ten_feasible_starts(scene):
    assert failing(scene) == {}


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_every_task_succeeds_on_the_original_desk(original_assets):
    assert failing("D", str(original_assets)) == {}


@pytest.mark.parametrize("first", ["rotate_red_block_right", "push_red_block_left", "stack_block", "unstack_block"])
@pytest.mark.parametrize("then", ["open_drawer", "turn_on_led", "move_slider_left"])
def test_blocks_that_a_command_is_not_about_stay_where_the_command_before_left_them(first, then):
    """A command ends in the step in which it is fulfilled, often with a block still between the fingers."""
    with Desk("D", cameras=()) as desk:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            robot_obs, scene_obs = sample_start(desk, first, rng)
            scene_obs[[SLIDE, DRAWER, LED]] = 0
            done, left, before = fulfil(desk, desk.reset(robot_obs, scene_obs), first, rng)
            assert done
            done, after, _ = fulfil(desk, left, then, rng, before=before)
            assert done
            blocks = [block_pose(k) for k in range(len(COLORS))]
            moved = [np.linalg.norm((after["scene_obs"] - left["scene_obs"])[block][:2]) for block in blocks]
            assert max(moved) < (0.3 if first == "unstack_block" else 0.05)  # the upper block is put down beside


@pytest.fixture(scope="module")
def demonstrations():
    """Two of each task in scene D."""
    with Desk("D", cameras=()) as desk:
        found = [demonstrate(desk, task, np.random.default_rng([4, k])) for task in TASKS for k in range(2)]
    assert sum(d is not None for d in found) >= 0.9 * len(found)
    return [d for d in found if d is not None]


def test_actions_stay_within_a_relative_step_and_imply_the_relative_ones(demonstrations):
    for demonstration in demonstrations:
        assert 5 < len(demonstration) <= STEPS_PER_COMMAND
        rows = zip(*(demonstration.frames[key] for key in ("actions", "rel_actions", "robot_obs")), strict=True)
        for action, relative, robot_obs in rows:
            np.testing.assert_array_equal(relative, relative_action(action, robot_obs))
            np.testing.assert_allclose(robot_obs[:3] + relative[:3] * 0.02, action[:3], atol=1e-9)
            turn = robot_obs[3:6] + relative[3:6] * 0.05 - action[3:6]
            np.testing.assert_allclose((turn + np.pi) % (2 * np.pi), np.pi, atol=1e-9)
            assert action[6] in (-1, 1)


def test_replayed_actions_fulfil_the_task_again(demonstrations):
    again = 0
    with Desk("D", cameras=()) as desk:
        for demonstration in demonstrations:
            frames = demonstration.frames
            desk.reset(frames["robot_obs"][0], frames["scene_obs"][0])
            start = desk.snapshot()
            for action in frames["actions"]:
                desk.step(action, "abs")
                if is_fulfilled(demonstration.task, start, desk.snapshot()):
                    again += 1
                    break
    assert again >= 0.9 * len(demonstrations)  # measured: 195 of 204


def test_recorded_states_reproduce_the_recorded_observations(demonstrations):
    """To 1 mm, apart from what was moving: a state holds no velocities."""
    robot, scene, lights = [], {}, []
    with Desk("D", cameras=()) as desk:
        for demonstration in demonstrations:
            frames = demonstration.frames
            for t in range(0, len(frames["actions"]), 20):
                obs = desk.reset(frames["robot_obs"][t], frames["scene_obs"][t])
                robot.append(np.abs(obs["robot_obs"] - frames["robot_obs"][t]))
                difference = np.abs(obs["scene_obs"] - frames["scene_obs"][t])
                lights.append(difference[4:6].max())
                # furniture and block positions; the angles of a block on its side jump
                parts = np.delete(difference, np.r_[9:12, 15:18, 21:24])
                scene.setdefault(demonstration.task, []).append(parts.max())
    robot = np.array(robot)
    assert np.median(robot[:, :3]) < 1e-3
    assert robot[:, :3].max() < 5e-3
    assert np.percentile(robot[:, 6:14], 95) < 5e-3  # gripper's width and the arm's joints
    assert (robot[:, 14] == 0).all()
    assert max(lights) == 0
    # a block in motion is a frame ahead
    assert max(np.median(found) for found in scene.values()) < 1e-3
    assert np.percentile(np.concatenate(list(scene.values())), 90) < 5e-3


@pytest.mark.parametrize("task", ["turn_off_led", "lift_red_block_table", "open_drawer"])
def test_recorded_states_reproduce_the_recorded_pictures(task):
    with Desk("A") as desk:
        frames = demonstrate(desk, task, np.random.default_rng(1), noise=0.0).frames
        for t in np.linspace(0, len(frames["actions"]) - 1, 4).astype(int):
            obs = desk.reset(frames["robot_obs"][t], frames["scene_obs"][t])
            for camera, maximum in (("rgb_static", 0.5), ("rgb_gripper", 3.0)):  # half a millimetre apart
                difference = np.abs(obs[camera].astype(int) - frames[camera][t])
                assert difference.mean() < maximum


class Clumsy(Disturbance):
    """Lets go for ten steps, once, `when` steps after the open hand was closed."""

    def __init__(self, when):
        super().__init__(0.0, np.random.default_rng(0))
        self.opened, self.closed, self.when = False, 0, when

    def of(self, action, careful):
        self.opened |= action[6] > 0
        self.closed += bool(self.opened and action[6] < 0)
        if action[6] < 0 and self.when < self.closed <= self.when + 10:
            return np.concatenate([action[:6], [1.0]])
        return action


@pytest.mark.parametrize(
    ("task", "when"),
    [("lift_red_block_table", 6), ("lift_blue_block_drawer", 8), ("rotate_pink_block_right", 15)],
)
def test_a_block_that_slipped_is_taken_again(task, when, monkeypatch):
    monkeypatch.setattr("lerobot_lansar.demos.demonstrator.Disturbance", lambda noise, rng: Clumsy(when))
    with Desk("D", cameras=()) as desk:
        tries = [demonstrate(desk, task, np.random.default_rng([5, k]), variety=0.0) for k in range(4)]
    again = [d.frames["actions"][:, 6] for d in tries if d is not None]
    assert len(again) >= 3
    assert sum((np.diff(gripper) < 0).sum() >= 2 for gripper in again) >= 3  # closed, lost it, closed again


TAKEOVERS = 2
"""Of each task in each scene."""


def takeovers(job):
    """How many of a task's possible takeovers end in success, and how many takeovers were possible."""
    scene, task = job
    done = possible = 0
    desk = desk_of(scene)
    for k in range(TAKEOVERS):
        rng = np.random.default_rng([6, k, list(TASKS).index(task)])
        try:
            takeover = interrupt(desk, task, rng)
            possible += takeover.feasible
            done += takeover.feasible and finishes(desk, task, takeover, rng) > 0
        except SimulationError:
            continue
    return done, possible


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_another_demonstrator_finishes_interrupted_tasks_of_every_kind():
    jobs = [(scene, task) for task in TASKS for scene in SCENES]
    found = np.array(list(in_processes(takeovers, jobs, PROCESSES, ordered=True))).reshape(len(TASKS), -1, 2)
    done, possible = found.sum(axis=1).T
    assert {task: (d, p) for task, d, p in zip(TASKS, done, possible, strict=True) if d < p - 1} == {}
    assert possible.min() >= 2
    assert possible.sum() >= 0.8 * TAKEOVERS * len(jobs)
    assert done.sum() >= 0.95 * possible.sum()


@pytest.mark.parametrize(("done", "task"), [(0.7, "right"), (-0.7, "right"), (0.7, "left"), (-0.7, "left")])
def test_a_block_half_turned_is_turned_the_rest(done, task):
    """By 60 degrees from where it lay at the command, which is the state `start`."""
    name = f"rotate_red_block_{task}"
    with Desk("D", cameras=()) as desk:
        rng = np.random.default_rng(8)
        start = desk.reset(*sample_start(desk, name, rng))
        begun = desk.snapshot()
        turned = start["scene_obs"].copy()
        turned[block_pose(0)][5] += done
        obs = desk.reset(start["robot_obs"], turned)
        steps = carry_out(desk, obs, SKILLS[name], rng, start=start, noise=0.0)
        assert any(is_fulfilled(name, begun, now) for *_, now in steps)


def test_the_block_held_at_the_command_is_placed_not_the_nearest_one():
    with Desk("D", cameras=()) as desk:
        rng = np.random.default_rng(1)
        start = desk.reset(*sample_start(desk, "place_in_drawer", rng))
        begun = desk.snapshot()
        (held,) = begun.touched_by_robot
        dropped = start["scene_obs"].copy()
        dropped[block_pose(COLORS.index(held))] = [0.2, -0.1, TABLE_Z, 0, 0, np.pi / 2]
        other = next(c for c in COLORS if c != held)
        dropped[block_pose(COLORS.index(other))] = [0.05, -0.1, TABLE_Z, 0, 0, np.pi / 2]
        away = start["robot_obs"].copy()
        away[GRIPPER_WIDTH], away[GRIPPER_ACTION] = 0.08, 1.0
        obs = desk.reset(away, dropped)
        steps = carry_out(desk, obs, SKILLS["place_in_drawer"], rng, start=start, noise=0.0)
        assert any(is_fulfilled("place_in_drawer", begun, now) for *_, now in steps)


def test_a_moving_hand_goes_on_moving():
    """The first action continues at the speed that `before` shows; without `before` it starts from rest."""
    first = {}
    led = SKILLS["turn_on_led"]
    with Desk("D", cameras=()) as desk:
        start = sample_start(desk, "turn_on_led", np.random.default_rng(0))
        for known in (False, True):
            before = now = desk.reset(*start)
            for _, after, _ in carry_out(desk, now, led, np.random.default_rng(0), noise=0.0, steps=12):
                before, now = now, after
            rng = np.random.default_rng(0)
            frame, *_ = next(carry_out(desk, now, led, rng, before=before if known else None, noise=0.0))
            first[known] = np.linalg.norm(frame["rel_actions"][:3])
    assert first[True] > 2 * first[False]


def test_a_drawer_that_slid_back_is_pulled_again():
    with Desk("D", cameras=()) as desk:
        rng = np.random.default_rng(3)
        obs = desk.reset(*sample_start(desk, "open_drawer", rng))
        begun, slid_back, pulled_again = desk.snapshot(), False, False
        for _, after, now in carry_out(desk, obs, SKILLS["open_drawer"], rng, variety=0.0, noise=0.0):
            if after["scene_obs"][DRAWER] > 0.08 and not slid_back:
                closed = after["scene_obs"].copy()
                closed[DRAWER] = begun.drawer
                desk.reset(after["robot_obs"], closed)
                slid_back = True
            elif slid_back and is_fulfilled("open_drawer", begun, now):
                pulled_again = True
                break
    assert slid_back
    assert pulled_again


def test_demonstrations_end_as_soon_as_the_oracle_is_and_stays_satisfied(demonstrations):
    """Checked on the recorded states on a fresh desk; contacts of what was moving may differ."""
    agreed = 0
    with Desk("D", cameras=()) as desk:
        for demonstration in demonstrations:
            snapshots = []
            for t in (0, len(demonstration) // 2, len(demonstration) - 1):
                desk.reset(demonstration.frames["robot_obs"][t], demonstration.frames["scene_obs"][t])
                snapshots.append(desk.snapshot())
            fulfilled = partial(is_fulfilled, demonstration.task)
            agreed += not fulfilled(snapshots[0], snapshots[1]) and fulfilled(snapshots[0], snapshots[2])
    assert agreed >= 0.9 * len(demonstrations)


def test_the_hand_moves_smoothly_and_at_a_human_speed():
    with Desk("D", cameras=()) as desk:
        for task in ("lift_red_block_table", "open_drawer", "stack_block"):
            frames = demonstrate(desk, task, np.random.default_rng(3), noise=0.0).frames
            speed = np.linalg.norm(np.diff(frames["robot_obs"][:, :3], axis=0), axis=1)
            assert 0.002 < speed.mean() < 0.008  # m per control step: 0.06 to 0.24 m/s
            assert speed.max() < 1.3 * TOP_SPEED
            change = np.abs(np.diff(frames["rel_actions"][:, :6], axis=0))
            assert np.percentile(change, 99) < 0.35


def test_variety_changes_the_motion_and_without_it_the_motion_repeats():
    def way(seed, variety):
        with Desk("D", cameras=()) as desk:
            return demonstrate(desk, "turn_on_led", np.random.default_rng(seed), 0.0, variety)

    def differences(variety):
        """In the hand's way to the button, from the same start: only the style's seed differs."""
        with Desk("D", cameras=()) as desk:
            start = sample_start(desk, "turn_on_led", np.random.default_rng(0))
            ways = []
            for seed in range(4):
                obs = desk.reset(*start)
                steps = carry_out(
                    desk,
                    obs,
                    SKILLS["turn_on_led"],
                    np.random.default_rng(seed),
                    variety=variety,
                    noise=0.0,
                    steps=40,
                )
                ways.append(np.array([after["robot_obs"][:3] for _, after, _ in steps]))
        return np.ptp(ways, axis=0).max()

    assert differences(0.0) == 0
    assert differences(1.0) > 0.01
    one, same = way(2, 1.0), way(2, 1.0)
    assert all(np.array_equal(one.frames[key], same.frames[key]) for key in one.frames)


def test_noise_moves_the_hand_but_not_what_is_recorded():
    with Desk("D", cameras=()) as desk:
        frames = demonstrate(desk, "open_drawer", np.random.default_rng(2), noise=0.2).frames
    reached = np.diff(frames["robot_obs"][:, :3], axis=0)
    asked = 0.5 * (frames["actions"][:-1, :3] - frames["robot_obs"][:-1, :3])  # the arm covers half of the distance
    strays = np.linalg.norm(reached - asked, axis=1)
    assert strays.max() > 0.004
    steady = np.abs(np.diff(frames["rel_actions"][:, :3], axis=0))
    assert np.median(steady) < 0.1  # 0.19 if what is executed were recorded
