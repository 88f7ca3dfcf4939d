"""Procedural people: seeded skin, eyes, lips, brows, hair, beards and glasses for the parametric head."""

from scenes.people.glasses import Glasses, GlassesStyle, wear_glasses
from scenes.people.person import Person, sample_person
from scenes.people.skin import paint

__all__ = ["Glasses", "GlassesStyle", "Person", "paint", "sample_person", "wear_glasses"]
