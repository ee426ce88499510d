"""Write what the node has learnt of cameras and sensors into new files, while it drives."""

from contextlib import suppress
from importlib.metadata import version

import jax
import numpy as np

from jaxnav.commands.drive.ros_setup import path_of
from jaxnav.core.filter.errors import EACH
from jaxnav.core.filter.odometry import LEARNT, SENSORS_END
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput
from jaxnav.files import load_rig, load_vehicle
from jaxnav.files.provenance import calibrated_now
from jaxnav.files.ros import RosFile
from jaxnav.files.vehicles import as_car
from jaxnav.files.writing import atomic_write_all
from jaxnav.recordings.adoption import (
    NEVER_SURE,
    NOTHING_KEPT,
    adopted_files,
    is_other_rig,
    is_other_vehicle,
)
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt, errors_of

_WHERE = "save"  # of what is wrong with none of the files


class LearntKeeper:
    """An observer that keeps what the drive has learnt when it was last sure of its pose.

    What `save` writes is what `jaxnav calibrate adopt --rig --vehicle` writes of the same drive's
    recording, but for the provenance and the rounding of a recording.
    """

    faults = Fault(0)
    closing_note: str | None = None

    def __init__(self, file: RosFile, setup: DriveSetup):
        """Args:
        file: names rig and vehicle, which are read anew: as exact as they are.
        """
        self._file, self._setup = file, setup
        self._known: tuple[np.ndarray, np.ndarray] | None = None

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        if outcome.output.located and outcome.output.decided:
            errors, sigma = errors_of(outcome.belief.bank)
            if np.isfinite(errors).all():
                self._known = errors, sigma

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""

    def save(self, folder: str) -> str:
        """Write the new files into a folder that is there; return what was written and learnt.

        Raises:
            BadInput: nothing is learnt yet, the folder is missing or holds such a file already, or
                rig or vehicle are not those any more that are driven with. Nothing is written.
        """
        known, target = self._known, self._file.path.parent / folder
        if known is None:
            raise BadInput(_WHERE, NEVER_SURE)
        is_there = False
        with suppress(OSError):  # a name that is too long, say
            is_there = bool(folder) and target.is_dir()
        if not is_there:
            raise BadInput(_WHERE, f"there is no folder {target if folder else repr(folder)}")
        learnt, texts = self._adopted(known)
        for name in texts:
            if (target / name).exists():
                raise BadInput(target / name, "is there already: nothing is written over")
        atomic_write_all({target / name: text for name, text in texts.items()})
        found = learnt.sentences() or ["nothing is off by three of its sigmas"]
        return f"{', '.join(texts)} in {target}: {'; '.join(found)}"

    def warm_up(self) -> None:
        """Compile what `save` calls: some twenty operations, while others drive."""
        count = SENSORS_END - LEARNT + EACH * len(self._setup.rig)
        with suppress(BadInput):  # said by who saves
            self._adopted((np.zeros(count), np.ones(count)))

    def _adopted(self, known: tuple[np.ndarray, np.ndarray]) -> tuple[Learnt, dict[str, str]]:
        """What has been learnt, and the new files by their names."""
        rig_path, vehicle_path = path_of(self._file, "rig"), path_of(self._file, "vehicle")
        setup = self._setup
        with jax.enable_x64(True):
            learnt = Learnt.from_errors(*known, setup.rig, setup.vehicle)
            if learnt is None:
                raise BadInput(_WHERE, f"the drive {NOTHING_KEPT}")
            rig, vehicle = load_rig(rig_path), as_car(load_vehicle(vehicle_path), vehicle_path)
            if is_other_rig(rig, setup.rig):
                raise BadInput(rig_path, "has other cameras by now than those driven with")
            if is_other_vehicle(vehicle, as_car(setup.vehicle, vehicle_path)):
                raise BadInput(vehicle_path, "has other corrections by now than those driven with")
            calibrated = calibrated_now(f"jaxnav {version('jaxnav')} ros, ~/save", known)
            return learnt, adopted_files(setup, learnt, calibrated, rig, vehicle)
