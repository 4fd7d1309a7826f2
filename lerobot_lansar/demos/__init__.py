"""Demonstrations: made by a script or by a person, written in CALVIN's on-disk format.

skills/          what to do: waypoints for each of the 34 tasks
moves            what skills are built from: waypoints, the view of the desk, travelling, grasps
motion           waypoints to actions: smooth, with noise
demonstrator     one task, from a random start or from where the desk is
interrupted      takeovers in the middle of a task, to measure the demonstrator by
takeovers        chains in which a policy acts and the demonstrator takes over
stuck            when a policy is stuck
play             tasks one after the other without a reset, and the language windows cut from that
calvin_folder    frames, windows and sentences on disk
record_config    the options of lansar-record
record           lansar-record: units recorded by workers, then published as two splits
teleop           lansar-play: a person at the keyboard
video            an mp4 written picture by picture
"""
