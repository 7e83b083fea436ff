"""Recipes: named functions that return fresh configs."""

from cotap.configs.base import BASE_RECIPES, CONTINUATIONS, BaseTraining
from cotap.configs.distill import DISTILL_CONTINUATIONS, DISTILL_RECIPES, OTHER_TERMS, DistillTraining, as_base
from cotap.configs.serialization import from_plain, to_plain

__all__ = [
    "BASE_RECIPES",
    "CONTINUATIONS",
    "DISTILL_CONTINUATIONS",
    "DISTILL_RECIPES",
    "OTHER_TERMS",
    "BaseTraining",
    "DistillTraining",
    "as_base",
    "from_plain",
    "to_plain",
]
