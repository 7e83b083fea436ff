"""Batched evaluation: protocols as data, rollouts, metrics on arrays, reports."""
