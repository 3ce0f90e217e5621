"""Where the lane of a platoon keeps what. What is one for the whole episode (step, command, leader's way) stands in `tailgate.fused.rows`.

Each car has a *record* of rows in the `window`, which is kept between two calls, and another in `s`, behind the rows of the block, for
what a step computes on its way. Within a record a row's name is its offset: `car[V + i]`. Where records begin depends on how many cars
there are, and is in `f` (`tailgate.fused.constants`).
"""

import numpy as np

from .rows import LANES

SENSORS, LINKS = 3, 6  # distance, velocity, acceleration; + the message


class _Record:
    """Rows that follow each other."""

    def __init__(self) -> None:
        self.rows = 0

    def row(self, width: int = 1) -> np.uint64:
        first = np.uint64(LANES * self.rows)
        self.rows += width
        return first


_car = _Record()
X, V, A = _car.row(), _car.row(), _car.row()  # position, speed, acceleration
DRIVEN = _car.row()  # what the actuator made of the last command
COMMAND = _car.row()
LAW = _car.row()  # f, the state of its controller
TOLD = _car.row()  # what it knows of the leader's input
SENT = _car.row(LINKS)
SEEN = _car.row()  # the speed ahead when a trigger looked last
BELIEF = _car.row(0)  # last, as many rows as there are states: xh_i; and where readings are lost which of them are there, SENSORS
CAR_ROWS = _car.rows

_work = _Record()
ARRIVED = _work.row(LINKS)
R = _work.row(SENSORS)  # the innovation
VALID = _work.row(SENSORS)  # of a car that may miss a reading
SCORE, ALARM = _work.row(), _work.row()
NEXT = _work.row()  # what f is drawn towards
APPLIED = _work.row()
GAP, AHEAD = _work.row(), _work.row()  # to the car ahead, and its speed
SHOWN_V, SHOWN_A, SHOWN_U = _work.row(), _work.row(), _work.row()  # what an observation shows of the record: speed, acceleration, command
SHOWN_Y = _work.row(2)  # and readings
WORK_ROWS = _work.rows
