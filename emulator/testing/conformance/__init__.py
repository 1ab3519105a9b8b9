"""Conformance of agents written without vnet: plays the emulator's side in scenes, and checks each answer.

`findings` lists the checks and collects what they say, `scene` is the agent under test and what all scenes share,
`courses` grant windows and send batches, and `play` is the table of scenes.
"""
