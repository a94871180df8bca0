"""The arm in `arm.xml`: what moves it, and what its force/torque sensor feels."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

import mujoco
from bota_ethercat.client import Client, World
from bota_ethercat.world import Felt

if TYPE_CHECKING:
    from docs.examples.mujoco.identify import Identification
    from docs.examples.mujoco.touch import Touch

STEP_S: Final = 0.001
READY: Final = (0.0, 20.0, 100.0, 0.0, -30.0, 0.0)  # degrees: the tool before the wall, level
_SHOWN_EVERY: Final = 20  # steps
_LARGEST_LAG_S: Final = 0.05  # behind which no step is made up for
_TEMPERATURE: Final = 5.0  # °C, sent: no running sensor's own, which tells it from others
_MOST_OTHERS: Final = 500  # readings of another temperature in a row


class Arm:
    """Six position-controlled joints in MuJoCo, one step a millisecond.

    `velocity` (3,), m/s, is commanded of the tip, in the base's frame, without turning.
    """

    def __init__(self) -> None:
        self.model: Any = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("arm.xml")))
        self.data: Any = mujoco.MjData(self.model)
        self.velocity = np.zeros(3)
        self._tip, self._sensor = (self.model.site(name).id for name in ("tip", "sensor"))
        self._jacobian = np.zeros((6, self.model.nv))
        self.data.qpos[:] = self.data.ctrl[:] = np.radians(READY)
        mujoco.mj_forward(self.model, self.data)

    @property
    def tip(self) -> NDArray[np.float64]:
        """Position of the tip, (3,) m, in the base's frame."""
        return np.array(self.data.site_xpos[self._tip])

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Turns the sensor's vectors into the base's, (3, 3)."""
        return np.array(self.data.site_xmat[self._sensor]).reshape(3, 3)

    @property
    def joints(self) -> NDArray[np.float64]:
        """Where the joints are to be, (6,) rad."""
        return np.array(self.data.ctrl)

    def turn_to(self, joints: ArrayLike) -> None:
        """Where the joints are to be from the next step on, (6,) rad."""
        self.data.ctrl[:] = joints

    def step(self, _seconds: float = 0.0) -> Felt:
        """Go on by a millisecond; what the sensor feels then. A world: `Simulation(world=arm.step)`."""
        if self.velocity.any():
            mujoco.mj_jacSite(self.model, self.data, self._jacobian[:3], self._jacobian[3:], self._tip)
            twist = np.append(self.velocity, np.zeros(3)) * STEP_S
            self.data.ctrl += np.linalg.pinv(self._jacobian) @ twist
        mujoco.mj_step(self.model, self.data)
        values = self.data.sensordata.tolist()
        # MuJoCo gives what the arm does to the tool; the sensor feels the opposite.
        return Felt(tuple(-value for value in values[:6]), tuple(values[6:9]), tuple(values[9:12]))

    @contextlib.contextmanager
    def shown(self) -> Iterator[Any]:
        """A window, where there is a screen: `sync` renews it; None where there is none."""
        import glfw  # noqa: PLC0415 - slow, and the tests do without

        from mujoco import viewer  # noqa: PLC0415 - as above

        glfw.ERROR_REPORTING = "ignore"
        # Tried first, for where the viewer finds no screen it ends the process.
        if not (glfw.init() and glfw.create_window(640, 480, "arm", None, None)):
            why: Any = glfw.get_error()[1]  # bytes, whatever its types say
            print(f"no window: {why.decode()}", flush=True)
            yield None
            return
        glfw.terminate()
        with viewer.launch_passive(self.model, self.data, show_left_ui=False, show_right_ui=False) as window:
            mujoco.mjv_defaultFreeCamera(self.model, window.cam)
            yield window
        for thread in threading.enumerate():  # of the viewer, which must not draw when Python ends GLFW
            if thread.daemon:
                thread.join()


def arguments(description: str) -> argparse.ArgumentParser:
    """What all examples take."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--world", default="/tmp/world", metavar="PATH")  # noqa: S108 - as in the documentation
    parser.add_argument("--port", type=int, default=12001, help="of the server (%(default)s)")
    return parser


def perform(task: Identification | Touch, arm: Arm, options: argparse.Namespace) -> None:
    """In real time, a cycle a millisecond, until the task is done; prints each change of condition."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends it at once, with the window's threads
    if not Path(options.world).is_socket():
        print(f"waiting for a virtual sensor with --world {options.world}", flush=True)
        while not Path(options.world).is_socket():
            time.sleep(0.1)
    with World(options.world) as world, Client(options.port) as sensor, arm.shown() as window:
        condition, others, due = None, 0, time.monotonic()
        for number in itertools.count():
            felt = arm.step()
            world.send(due, felt.wrench, felt.acceleration, felt.angular_rate, _TEMPERATURE)
            reading = sensor.latest()
            if reading.fresh and reading.sample is not None:
                others = others + 1 if abs(reading.sample.temperature - _TEMPERATURE) > 1.0 else 0
            if others > _MOST_OTHERS:
                raise SystemExit(
                    f"the sensor at port {options.port} does not measure what is sent to {options.world}: "
                    f'start ethercat-server virtual {options.port} --virtual "--world {options.world}", or '
                    "give the --port of the server of that virtual sensor"
                )
            task.update(reading, number * STEP_S)
            if task.done:
                return
            if reading.condition is not condition:
                condition = reading.condition
                print(f"{number * STEP_S:7.3f} s: {condition}", flush=True)
            if window is not None and number % _SHOWN_EVERY == 0:
                if not window.is_running():
                    raise SystemExit("the window was closed")
                window.sync()
            due = max(due + STEP_S, time.monotonic() - _LARGEST_LAG_S)
            time.sleep(max(0.0, due - time.monotonic()))
