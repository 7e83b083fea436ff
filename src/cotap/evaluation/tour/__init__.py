"""The punch tour: 90 s of walking to waypoints while arms wander and punches land (docs/tour.md)."""
