"""Models of robots built from primitives with ``MjSpec``; joint groups, default poses, gains, limits as dataclasses.

A robot is data. What moves it lives in ``physics``, and what it is asked to do in ``envs``.
"""
