"""2D keypoints of calibrated cameras in, smooth 3D poses out. `bundlemocap.pyi` describes it."""

from .bundlemocap import *  # noqa: F403
from .bundlemocap import __version__  # noqa: F401
