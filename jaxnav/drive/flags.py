"""The faults, rejections and health states of a drive, named for records, screens and tests."""

import enum
from typing import Any


class Fault(enum.IntFlag):
    """Data or hardware that failed; sound data that the filter does not believe are a `Reject`."""

    CAMERA_STALE = enum.auto()  # one or more gave no frame in time
    CAMERAS_STALE = enum.auto()  # all of them
    FRAME_UNUSABLE = enum.auto()  # no image, of a wrong size, or without any contrast
    # A picture repeats under new stamps, or does not change while the odometer goes.
    FRAME_FROZEN = enum.auto()
    UNKNOWN_MARKER = enum.auto()
    DUPLICATE_MARKER = enum.auto()  # one id at several places, in an image or by several cameras
    CORNERS_NOT_FINITE = enum.auto()
    STAMP_INVALID = enum.auto()  # repeated, in the future, too old, zero or negative
    CLOCK_JUMPED = enum.auto()  # the clock of a source has jumped, or the loop itself slept
    ODOMETRY_STALE = enum.auto()
    ODOMETRY_INVALID = enum.auto()  # the driver says so, or a value is none that a vehicle can have
    ODOMETRY_STUCK = enum.auto()  # repeated values while the car moves, or corners move at rest
    NO_MARKER = enum.auto()  # for a second
    UNSURE = enum.auto()  # position sigma beyond its limit
    FAR_FROM_FIX = enum.auto()  # distance driven without a marker beyond its limit
    NOT_FINITE = enum.auto()  # the estimate was not finite
    RESTARTED = enum.auto()  # the belief was contradicted and given up
    HELD = enum.auto()  # by the guard: something was late, and the file says `resume: true`
    VEHICLE_FAILED = enum.auto()  # it could not be read or written
    DEADLINE_MISSED = enum.auto()  # a cycle took longer than its period
    RECORDER_BEHIND = enum.auto()  # messages were left out
    RECORDER_FAILED = enum.auto()  # disk full, the file is gone, or another observer has raised
    NOTHING_MOVES = enum.auto()  # the throttle pulls, and neither wheels nor any corner move
    RESTARTED_OFTEN = enum.auto()  # too many restarts in a short time
    RELOCATED = enum.auto()  # the corners give a pose that no wheel slip explains
    WAYS_DISPUTED = enum.auto()  # the ways by corners and by odometer differ
    ODOMETRY_DOUBTFUL = enum.auto()  # no marker, and the odometer contradicts the throttle
    MARKER_OUTVOTED = enum.auto()  # its corners contradict what the others agree on
    CAMERA_LATE = enum.auto()  # images are older or newer than their stamps; health stays as it is
    CAMERA_OUTVOTED = enum.auto()  # it does not see markers where another does
    # The estimate goes on without the gyro, and health stays as it is.
    GYRO_STALE = enum.auto()  # its file says that there is one, and it gave no rate in time
    GYRO_INVALID = enum.auto()  # a reading is no rate, at the gyro's limit, or repeats itself
    GYRO_CONTRADICTED = enum.auto()  # by the two others that tell the turn: it is left out
    # What follows a command is not what was commanded: of the throttle or of ahead, of the left,
    # and of the steering or of the turn.
    DRIVE_CONTRADICTED = enum.auto()
    SIDEWAYS_CONTRADICTED = enum.auto()
    TURN_CONTRADICTED = enum.auto()
    LEFT_ROUTE = enum.auto()  # farther from it than its file allows
    # Corners come nearer by another way than the odometer tells, from the start: the size of a
    # marker, a focal length, a camera's direction or the wheels are not as their file says.
    FILES_CONTRADICTED = enum.auto()
    CORNERS_MIRRORED = enum.auto()  # they run as of a marker seen from behind: in another order


class Reject(enum.IntFlag):
    """Good data that contradicts the rest."""

    INNOVATION = enum.auto()  # the filter has not accepted the corners
    INNOVATION_LARGE = enum.auto()  # accepted, though NIS is above half of the gate
    TOO_LATE = enum.auto()  # older than all events in the history
    ODOMETRY = enum.auto()  # a speed that the vehicle can't have reached


class Health(enum.IntEnum):
    """The vehicle's health, from waiting to driving to standing; from OK on, larger is worse."""

    INIT = 0  # nothing is known yet
    ALIGNED = 1  # located, but several poses are possible: it explores
    OK = 2
    DEAD_RECKONING = 3  # no marker for a second
    DEGRADED = 4  # slow: no marker for two seconds, odometry or cameras missing, contradictions
    STOP = 5


def names(flags: enum.IntFlag) -> list[str]:
    """The names of the flags that are set."""
    return [flag.name or "" for flag in type(flags) if flag in flags]


def counts(kind: type[enum.IntFlag], values: Any) -> dict[str, int]:
    """How many of an array of flags have each one, of those that any has."""
    found = {str(flag.name): int(((values & flag.value) > 0).sum()) for flag in kind}
    return {name: count for name, count in found.items() if count}
