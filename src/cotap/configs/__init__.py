"""Recipes: named functions that return fresh configs."""

from cotap.configs.base import BASE_RECIPES, BaseTraining
from cotap.configs.distill import DISTILL_RECIPES, DistillTraining
from cotap.configs.serialization import from_plain, to_plain

__all__ = [
    "BASE_RECIPES",
    "DISTILL_RECIPES",
    "BaseTraining",
    "DistillTraining",
    "from_plain",
    "to_plain",
]
