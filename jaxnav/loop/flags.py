"""The faults, rejections and health states of a drive, named for records, screens and tests."""

import enum


class Fault(enum.IntFlag):
    """Data or hardware that failed; sound data that the filter does not believe are a `Reject`."""

    CAMERA_STALE = enum.auto()  # one or several gave no frame in time
    CAMERAS_STALE = enum.auto()  # all of them
    FRAME_UNUSABLE = enum.auto()  # no image, of a wrong size, or without any contrast
    # The same picture again and again, under new stamps, or one that stays while the odometer goes.
    FRAME_FROZEN = enum.auto()
    UNKNOWN_MARKER = enum.auto()
    DUPLICATE_MARKER = enum.auto()  # one id at several places in an image
    CORNERS_NOT_FINITE = enum.auto()
    STAMP_INVALID = enum.auto()  # repeated, of the future, zero or negative
    CLOCK_JUMPED = enum.auto()  # a source counts from elsewhere now, or the loop itself slept
    ODOMETRY_STALE = enum.auto()
    ODOMETRY_INVALID = enum.auto()  # the driver says so, or no number
    ODOMETRY_STUCK = enum.auto()  # the same numbers again and again while it moves, or corners do
    NO_MARKER = enum.auto()  # for a second
    UNSURE = enum.auto()  # position sigma beyond its limit
    FAR_FROM_FIX = enum.auto()  # distance driven without a marker beyond its limit
    NOT_FINITE = enum.auto()  # the estimate or the command was no number
    RESTARTED = enum.auto()  # all that was believed was contradicted and given up
    DETECTOR_FAILED = enum.auto()
    VEHICLE_FAILED = enum.auto()  # it could not be read or written
    DEADLINE_MISSED = enum.auto()  # a cycle took longer than its period
    RECORDER_BEHIND = enum.auto()  # messages were left out
    RECORDER_FAILED = enum.auto()  # disk full, or the file is gone
    NOTHING_MOVES = enum.auto()  # the throttle pulls, and neither wheels nor any corner move
    RESTARTED_OFTEN = enum.auto()  # given up again and again in a short time
    RELOCATED = enum.auto()  # the corners put it where no slip of its wheels can have brought it
    WAYS_DISPUTED = enum.auto()  # corners and odometer tell of different ways
    ODOMETRY_DOUBTFUL = enum.auto()  # no marker, and the odometer contradicts the throttle
    MARKER_OUTVOTED = enum.auto()  # its corners contradict what the others agree on
    CAMERA_LATE = enum.auto()  # images are older, or newer, than their stamps say; costs no health


class Reject(enum.IntFlag):
    """Good data that contradicts the rest."""

    INNOVATION = enum.auto()  # corners: the filter has not accepted them
    INNOVATION_LARGE = enum.auto()  # accepted, though NIS is above half of the gate
    TOO_LATE = enum.auto()  # older than all that the ring keeps
    ODOMETRY = enum.auto()  # a speed that the vehicle can't have reached


class Health(enum.IntEnum):
    """The vehicle's health, from waiting to driving to standing; from OK on, larger is worse."""

    INIT = 0  # nothing is known yet
    ALIGNED = 1  # located, but several poses are possible: it explores
    OK = 2
    DEAD_RECKONING = 3  # no marker for a second
    DEGRADED = 4  # slow: no marker for two, odometry or cameras missing, data that contradict
    STOP = 5


def names(flags: enum.IntFlag) -> list[str]:
    """The names of the flags that are set."""
    return [flag.name or "" for flag in type(flags) if flag in flags]
