"""2D keypoints of calibrated cameras in, smooth 3D poses out.

The world is right-handed, in metres, y up. Joints are in the order of `JOINTS`. Times are nanoseconds.
Arrays of attributes are read-only: change a copy, and make a new object of it.
Errors are raised as `Error`, with the file, the field and the fix; arguments of a wrong type are a `TypeError`.
What may be wrong with a file, or could not be read, is a warning.
"""

import os
from collections.abc import Mapping
from typing import Any, Literal, Self, final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "__version__",
    "Error",
    "JOINTS",
    "PARENTS",
    "FORMATS",
    "Camera",
    "Rig",
    "Keypoints",
    "Recording",
    "Messages",
    "Motion",
    "Solved",
    "Tracker",
    "Pose",
    "read_messages",
    "read_motions",
    "schemas",
    "solve",
    "main",
]
__version__: str

#: Names of the 22 joints.
JOINTS: list[str]
#: By joint: the index of its parent; -1 for the pelvis.
PARENTS: list[int]
#: By name of a format: the names of its points, in order. Of coco_wholebody_133 the first 23.
FORMATS: dict[str, list[str]]

_Path = str | os.PathLike[str]
_Format = Literal["body_25", "body_25b", "coco_17", "halpe_26", "coco_wholebody_133"]
_State = Literal["tracking", "coasting", "lost"]

class Error(Exception):
    """Why something cannot be done, and the fix."""

@final
class Camera:
    """A calibrated camera. `matrix`: 3 x 3, pixels. `rotation` (3 x 3) and `translation` (3, metres): from the
    world to the camera, as in OpenCV. `distortion`: OpenCV's 4, 5 or 8 numbers, or 4 of a fisheye. `time_offset_ns`:
    added to the times of its keypoints."""

    @property
    def name(self) -> str: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def matrix(self) -> NDArray[np.float64]: ...
    @property
    def rotation(self) -> NDArray[np.float64]: ...
    @property
    def translation(self) -> NDArray[np.float64]: ...
    @property
    def distortion(self) -> NDArray[np.float64]: ...
    @property
    def is_fisheye(self) -> bool: ...
    @property
    def time_offset_ns(self) -> int: ...

    def __new__(
        cls,
        name: str,
        size: tuple[int, int],
        matrix: NDArray[np.float64],
        rotation: NDArray[np.float64],
        translation: NDArray[np.float64],
        distortion: NDArray[np.float64] | list[float] | None = None,
        fisheye: bool = False,
        time_offset_ns: int = 0,
    ) -> Self: ...
    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n x 2) of places (n x 3, metres); NaN where the camera cannot see one. You may change this array."""

@final
class Rig:
    """The cameras of a calibration: at least two, with different names."""

    @property
    def cameras(self) -> list[Camera]: ...

    def __new__(cls, cameras: list[Camera]) -> Self: ...
    @staticmethod
    def read(
        path: _Path,
        up: str = "auto",
        unit: str = "auto",
        poses: str = "auto",
        set: str | None = None,
    ) -> Rig:
        """Reads a calibration of any kind that `bundlemocap rig --help` lists. `up`: the axis of its world that
        points up (x, y, z, -x, -y, -z); `unit`: m, cm, mm, in, ft; `poses`: camera-from-world, as in OpenCV, or
        world-from-camera; `set`: of several poses of the cameras in the file, those under this name."""
    def write(self, path: _Path, up: str = "z") -> None:
        """Writes TOML in metres, as Pose2Sim has it."""

@final
class Keypoints:
    """The detections of one camera. `points`: frames x people x points x 3 numbers, x and y in pixels and the
    confidence. A point that has confidence 0, is NaN or masked was not seen; people without any point are left out.
    With one person the axis of people may be left out. `frames`: the numbers of the images, so that lost ones are known;
    default: 0, 1, ... in order of time. `size`: width and height of the images, pixels; `None`: of the calibration."""

    @property
    def format(self) -> _Format: ...
    @property
    def times_ns(self) -> NDArray[np.int64]: ...
    @property
    def points(self) -> NDArray[np.float64]: ...
    @property
    def frames(self) -> NDArray[np.int64]: ...
    @property
    def size(self) -> tuple[int, int] | None: ...

    def __new__(
        cls,
        times_ns: NDArray[np.int64],
        points: NDArray[np.float64],
        format: _Format,
        *,
        frames: NDArray[np.int64] | None = None,
        size: tuple[int, int] | None = None,
    ) -> Self: ...

@final
class Recording:
    """The calibration and the detections of a take; `keypoints` by name of the camera. Without one of the cameras:
    `Recording(take.rig, {name: of for name, of in take.keypoints.items() if name != "cam03"})`."""

    @property
    def rig(self) -> Rig: ...
    @property
    def keypoints(self) -> Mapping[str, Keypoints]: ...

    def __new__(cls, rig: Rig, keypoints: Mapping[str, Keypoints]) -> Self: ...
    @staticmethod
    def read(path: _Path) -> Recording:
        """Reads a recording (.mcap). Cameras without calibration are left out, with a warning."""
    def write(self, path: _Path) -> None:
        """Writes a recording; a file that is there is replaced. It holds the rig and the keypoints: other messages
        and the metadata (settings, timecode) of a file that was read are not kept."""

@final
class Messages:
    """The messages of a recording, in the order of the file."""

    def __iter__(self) -> Self: ...
    def __next__(self) -> tuple[str, int, str, bytes]:
        """Topic, capture time (nanoseconds), full name of the type (bundlemocap.v1.Pose) and the message, encoded as
        protobuf. Messages of others have their own encodings and perhaps no type."""

def schemas() -> dict[str, bytes]:
    """The schemas of the messages, by full name such as `bundlemocap.v1.Pose`: serialised `FileDescriptorSet`s of
    protobuf. `bundlemocap.bus` has the messages as classes."""

def read_messages(path: _Path) -> Messages:
    """The messages of a recording (.mcap), also of a damaged one; a warning at the end says what it lost."""

@final
class Motion:
    """The poses of a performer, sorted by time.

    `positions`: n x 22 x 3, joint centres in the world, metres. `rotations`: n x 22 x 4, quaternions x, y, z, w:
    of the pelvis in the world, of the others in their parents; 0, 0, 0, 1 in a T-pose that faces +z. `deviations`:
    n x 22, the standard deviation of each position along each axis, metres; NaN where it is not known.
    `rest_positions`: 22 x 3, the T-pose with the pelvis at the origin."""

    @property
    def actor(self) -> str: ...
    @property
    def fps(self) -> float: ...
    @property
    def times_ns(self) -> NDArray[np.int64]: ...
    @property
    def positions(self) -> NDArray[np.float64]: ...
    @property
    def rotations(self) -> NDArray[np.float64]: ...
    @property
    def deviations(self) -> NDArray[np.float64]: ...
    @property
    def rest_positions(self) -> NDArray[np.float64]: ...
    @property
    def states(self) -> list[_State]: ...

    def __len__(self) -> int: ...

@final
class Solved:
    """`motions` by name of the performer; `summary`: the figures of `bundlemocap solve --json` with
    several performers."""

    @property
    def motions(self) -> dict[str, Motion]: ...
    @property
    def summary(self) -> dict[str, Any]: ...

def solve(
    recording: _Path | Recording,
    *,
    performers: int | Literal["auto"] | None = None,
    cameras: list[str] = ...,
    hold_out: list[str] = ...,
    config: _Path | None = None,
    out: _Path | None = None,
    overwrite: bool = False,
) -> Solved:
    """Solves a recording. `cameras`: use only these; `hold_out`: measure the error in these; `config`: a
    settings file; `out`: a folder for the files of `bundlemocap solve` (default: no files are left). An
    interrupt ends it while it solves, and no file is written then."""

def read_motions(path: _Path) -> dict[str, Motion]:
    """The poses of a solved recording (poses.mcap), by name of the performer."""

@final
class Pose:
    """A pose of a performer at a time; arrays as those of `Motion`."""

    @property
    def performer(self) -> str: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def state(self) -> _State: ...
    @property
    def positions(self) -> NDArray[np.float64]: ...
    @property
    def rotations(self) -> NDArray[np.float64]: ...
    @property
    def deviations(self) -> NDArray[np.float64]: ...

@final
class Tracker:
    """Solves frame by frame, with windows of ten frames at 60 Hz, longer ones for fast cameras. Several threads may share it: they wait for one
    another."""

    def __new__(
        cls,
        rig: Rig,
        format: _Format,
        *,
        performers: int | Literal["auto"] | None = None,
        config: _Path | None = None,
    ) -> Self: ...
    def add(
        self, camera: str, time_ns: int, points: NDArray[np.float64], frame: int | None = None
    ) -> list[Pose]:
        """Adds what a camera detected: (people x) points x 3 numbers, as in `Keypoints`; returns the poses that
        are new. Frames of a camera come in order of time. `frame`: the number of the image, so that lost ones are
        known; default: one more than the last."""
    def end(self) -> list[Pose]:
        """The last poses; nothing may be added after it."""
    def take_events(self) -> list[str]:
        """What happened since the last call, such as a performer who was lost: performer, kind, camera, details. The last
        10,000 events are kept."""

def main() -> None:
    """Runs the program with `sys.argv`, and ends the process."""
