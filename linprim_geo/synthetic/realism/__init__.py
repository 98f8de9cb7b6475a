"""Scenes that are rendered by path tracing (Mitsuba 3, the extra `realism`): light, materials, and exact geometry."""
