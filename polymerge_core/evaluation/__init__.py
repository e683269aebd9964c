"""How close a map is to a reference: the measures of the paper and those of the field."""

from polymerge_core.evaluation.result import Evaluation
from polymerge_core.evaluation.run import REGION_FROM, evaluate

__all__ = ["REGION_FROM", "Evaluation", "evaluate"]
