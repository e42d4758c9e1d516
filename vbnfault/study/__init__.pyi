"""List the public names of the package, each with the module that defines it."""

from .chunks import StudyFailed as StudyFailed
from .results import open_indices as open_indices
from .results import read_table as read_table
from .run import StudySummary as StudySummary
from .run import recompute as recompute
from .run import run_study as run_study
from .run import study as study
from .spec import Evaluation as Evaluation
from .spec import Evaluator as Evaluator
from .spec import Metric as Metric
from .spec import StudySpec as StudySpec
from .spec import load_study as load_study
from .spec import parse_study as parse_study
