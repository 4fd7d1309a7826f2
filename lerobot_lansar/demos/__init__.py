"""Demonstrations: made by a script or by a player, written in CALVIN's on-disk format.

skills/          what to do: waypoints for each of the 34 tasks
moves            what skills are made of: waypoints, the view of the desk, travelling, grasps
motion           waypoints to actions: smooth, with noise
demonstrator     one task from a random start, or from where the desk is
play_data        tasks one after the other, and the windows in it
calvin_folder    frames, windows and sentences on disk
record           lansar-record
play             lansar-play: a person at the keyboard
"""
