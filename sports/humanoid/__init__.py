"""The humanoid as data: body tables, strengths, joint limits, equipment, and its two writers."""

from sports.humanoid.body import Body, Dof, Link, Shape, equipment_names, load_body

__all__ = ["Body", "Dof", "Link", "Shape", "equipment_names", "load_body"]
