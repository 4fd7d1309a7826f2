"""`lansar-replay`: recorded demonstrations on the desk again, by their states and by their actions.

recordings       what was recorded: an episode of a LeRobotDataset, or a window of a CALVIN folder
outcome          sets the states or carries out the actions; deviations, and the oracle's verdicts
film             the video: recording and replays side by side
replay           options, tables, the command
"""
