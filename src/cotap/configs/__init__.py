"""Recipes: named functions that return fresh configs."""

from cotap.configs.base import BASE_RECIPES, BaseTraining
from cotap.configs.serialization import from_plain, to_plain

__all__ = ["BASE_RECIPES", "BaseTraining", "from_plain", "to_plain"]
