"""Control steps per second of the desk, beside a naive loop and the physics floor.

    python benchmarks/desk.py [--assets=DIR] [--steps=200] [--output=FILE.json]

The naive loop makes the calls that calvin_env makes in a step (inverse kinematics and one motor call per joint, eight
simulation steps, two pictures by TinyRenderer, one question per joint, contacts of every body) on the same bodies. The
physics floor is the time of the eight simulation steps alone, in the same motion. The cases take turns in one process,
and the medians of the rounds count; two processes run at the same time at the end. Run it with nothing else on the
machine.
"""

import json
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pybullet as p
from tqdm import tqdm

from lerobot_lansar.cameras import STATIC_EYE, STATIC_TARGET, STATIC_UP
from lerobot_lansar.desk import Desk, DeskError
from lerobot_lansar.desk.cameras import INTRINSICS

ROUNDS = 5


@dataclass
class Options:
    """What to measure."""

    # Control steps per case and round; a tenth of it for the naive loop.
    steps: int = 200
    scene: str = "D"
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    output: Path | None = None


class Naive:
    """The original's sequence of calls on a desk's own bodies."""

    def __init__(self, desk: Desk):
        self._desk = desk
        self._pose = desk.observe()["robot_obs"][:6]

    def step(self, action: np.ndarray) -> None:
        """One control step in relative mode with both pictures."""
        client, robot = self._desk._client, self._desk._robot.body
        self._pose = self._pose + action[:6] * ([0.02] * 3 + [0.05] * 3)
        joints = self._desk._robot.joints_for(self._pose[:3], self._pose[3:])
        arm = [(joint, value, 200, 2) for joint, value in enumerate(joints)]
        for joint, value, force, velocity in [*arm, (9, 0.04, 2, 1), (11, 0.04, 2, 1)]:
            p.setJointMotorControl2(
                bodyIndex=robot,
                jointIndex=joint,
                controlMode=p.POSITION_CONTROL,
                force=force,
                targetPosition=value,
                maxVelocity=velocity,
                physicsClientId=client,
            )
        for _ in range(8):
            p.stepSimulation(physicsClientId=client)
        self._picture(200, STATIC_EYE, STATIC_TARGET, STATIC_UP, "static")
        position, orientation = p.getLinkState(robot, 14, physicsClientId=client)[:2]
        rotation = np.array(p.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        self._picture(84, position, position + rotation[:, 1], -rotation[:, 2], "gripper")
        p.getLinkState(robot, 15, physicsClientId=client)
        for joint in (*range(7), 9, 11):
            p.getJointState(robot, joint, physicsClientId=client)
        for body in range(p.getNumBodies(physicsClientId=client)):
            p.getContactPoints(bodyA=body, physicsClientId=client)
            p.getBasePositionAndOrientation(body, physicsClientId=client)
            p.getBaseVelocity(body, physicsClientId=client)
        furniture = self._desk._furniture.body
        for joint in range(4):
            p.getJointState(furniture, joint, physicsClientId=client)

    def _picture(self, size: int, eye: object, target: object, up: object, camera: str) -> None:
        intrinsics = INTRINSICS[camera]
        p.getCameraImage(
            size,
            size,
            p.computeViewMatrix(eye, target, up),
            p.computeProjectionMatrixFOV(intrinsics.fov, 1.0, intrinsics.near, intrinsics.far),
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self._desk._client,
        )


def actions(seed: int = 0) -> Callable[[], np.ndarray]:
    """An endless supply of gentle relative actions."""
    rng = np.random.default_rng(seed)
    return lambda: np.array([*rng.uniform(-0.3, 0.3, 6), 1.0])


def seconds_per_step(step: Callable[[], object], steps: int) -> float:
    """Mean wall time of `step` over `steps` calls; a step that returns a number has timed itself."""
    total = 0.0
    for _ in range(steps):
        started = time.perf_counter()
        own = step()
        total += own if isinstance(own, float) else time.perf_counter() - started
    return total / steps


def cases(options: Options) -> dict[str, Callable[[], object]]:
    """Name of each case to its step."""

    def stepping(**settings: object) -> Callable[[], object]:
        act = actions()
        desk = Desk(options.scene, options.assets, **settings)  # type: ignore[arg-type]
        desk.step(act())  # compiles, loads meshes
        return lambda: desk.step(act())

    bare, judged, naive = (Desk(options.scene, options.assets, ()) for _ in range(3))
    start, slow = judged.snapshot(), Naive(naive)
    bare_act, judged_act, slow_act = actions(), actions(), actions()  # the same motion in every case

    def floor() -> float:
        bare._robot.command(bare_act(), relative=True)
        started = time.perf_counter()
        for _ in range(8):
            p.stepSimulation(physicsClientId=bare._client)
        return time.perf_counter() - started

    def with_oracle() -> None:
        judged.step(judged_act())
        judged.completed_tasks(start)

    return {
        "physics floor": floor,
        "no cameras": stepping(cameras=()),
        "no cameras, oracle": with_oracle,
        "both cameras, gl": stepping(),
        "both cameras, tiny": stepping(renderer="tiny"),
        "naive loop": lambda: slow.step(slow_act()),
    }


def run_alone(options: Options, steps: int, ready: object, go: object, result: object) -> None:
    """One of the two processes: steps a desk with both cameras when told to."""
    act = actions(os.getpid())
    desk = Desk(options.scene, options.assets)
    desk.step(act())
    ready.release()  # type: ignore[attr-defined]
    go.wait()  # type: ignore[attr-defined]
    result.put(seconds_per_step(lambda: desk.step(act()), steps))  # type: ignore[attr-defined]


def two_processes(options: Options, processes: int) -> float:
    """Control steps per second of `processes` desks with both cameras at the same time."""
    context = multiprocessing.get_context("spawn")
    ready, go, result = context.Semaphore(0), context.Event(), context.Queue()
    arguments = (options, options.steps * 3, ready, go, result)
    workers = [context.Process(target=run_alone, args=arguments) for _ in range(processes)]
    for worker in workers:
        worker.start()
    for _ in workers:
        ready.acquire()
    go.set()
    rate = sum(1 / result.get() for _ in workers)
    for worker in workers:
        worker.join()
    return rate


def differences(options: Options, ours: str, reference: str, states: int = 20) -> dict[str, float]:
    """Mean difference (of 255) between the pictures of two renderers in states along a random motion."""
    act = actions(1)
    means: dict[str, list[float]] = {"static": [], "gripper": []}
    with (
        Desk(options.scene, options.assets, (), ours) as one,
        Desk(options.scene, options.assets, (), reference) as other,
    ):
        one.reset(seed=1)
        other.reset(seed=1)
        for _ in range(states):
            for _ in range(5):
                action = act() * [3, 3, 3, 3, 3, 3, 1]
                one.step(action)
                other.step(action)
            for camera, values in means.items():
                a, b = (desk.render(camera).astype(int) for desk in (one, other))
                values.append(float(np.abs(a - b).mean()))
    return {camera: statistics.mean(values) for camera, values in means.items()}


def main() -> None:
    """Measures, prints the table, writes the figures."""
    options = draccus.parse(Options)
    steps = cases(options)
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in tqdm(range(ROUNDS), desc="rounds"):
        for name, step in steps.items():
            count = max(5, options.steps // (10 if name == "naive loop" else 1))
            times[name].append(seconds_per_step(step, count))
    medians = {name: statistics.median(values) for name, values in times.items()}
    runs = [(n, two_processes(options, n)) for _ in tqdm(range(ROUNDS), desc="processes") for n in (1, 2)]
    rates = {str(n): statistics.median(rate for count, rate in runs if count == n) for n in (1, 2)}
    kind = "original" if options.assets else "built-in"
    print(f"scene {options.scene}, {kind} assets, {os.cpu_count()} cores")
    print(f"{'':24s} steps/s   ms/step   floor x   naive loop /")
    for name, seconds in medians.items():
        print(
            f"{name:24s} {1 / seconds:7.1f} {1e3 * seconds:9.3f} {seconds / medians['physics floor']:9.2f}"
            f" {medians['naive loop'] / seconds:14.1f}"
        )
    print(f"both cameras, gl: 1 process {rates['1']:.1f} steps/s, 2 processes {rates['2']:.1f}: ", end="")
    print(f"{rates['2'] / rates['1']:.2f} times")
    compared = {}
    for ours, reference in (("tiny", "pybullet_tiny"), ("gl", "pybullet_gl")):
        try:
            compared[f"{ours} / {reference}"] = differences(options, ours, reference)
        except DeskError as error:
            print(f"{ours} not compared with {reference}: {error}")
    for name, means in compared.items():
        print(f"mean picture difference {name}: static {means['static']:.4f}, gripper {means['gripper']:.4f} of 255")
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        figures = {
            "scene": options.scene,
            "assets": kind,
            "machine": platform.platform(),
            "cores": os.cpu_count(),
            "seconds_per_step": medians,
            "steps_per_second_of_processes": rates,
            "mean_picture_difference": compared,
        }
        options.output.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
