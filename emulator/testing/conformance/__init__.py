"""Conformance of agents written without vnet: plays the emulator's side in scenes, and checks each answer.

`findings` collects what the checks say, `bench` is the router and the agent under test, `inspection` judges single
messages, `scene` is what all scenes share, `joining`, `lockstep` and `realtime` are the scenes, `play` plays them.
"""
