"""List the public names of the package, each with the module that defines it."""

from .directions import CentroidShift as CentroidShift
from .directions import LimbError as LimbError
from .directions import centroid_shift as centroid_shift
from .directions import limb_error as limb_error
from .features import FeatureLifetime as FeatureLifetime
from .features import Matches as Matches
from .features import Repeatability as Repeatability
from .features import corner_repeatability as corner_repeatability
from .features import corners as corners
from .features import feature_lifetime as feature_lifetime
from .features import match as match
from .features import match_precision as match_precision
from .features import matches_lost as matches_lost
from .features import orb_repeatability as orb_repeatability
from .features import right_matches as right_matches
from .geometry import CameraView as CameraView
from .geometry import relative_motion as relative_motion
from .geometry import reprojected as reprojected
from .tracks import Tracks as Tracks
from .tracks import tracks as tracks
from .two_views import RelativePose as RelativePose
from .two_views import RelativePoseError as RelativePoseError
from .two_views import relative_pose as relative_pose
from .two_views import relative_pose_error as relative_pose_error
