"""Kinds of cameras, one module each; a module states its kinds in `CAMERAS`, name -> dataclass.

A kind is a dataclass of settings, which scenario files give under `cameras`, with two methods:
`check(where)` raises `ConfigError` for values out of range, and
`add(builder, scene_graph, *, name, seed)` adds the camera to a simulation and returns its output
ports by the contract's names without the camera's (`color_image`, `depth_image`, `label_image` of
Drake's labels, `pose`, `time`).
"""
