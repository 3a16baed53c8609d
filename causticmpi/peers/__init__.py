"""Other renderers on our scenes: the same surfaces, camera and lights, equal CPU time, one thread, one reference.

`scripts/peers` runs it. Each renderer works in a process of its own, whose CPU time is the clock.
"""
