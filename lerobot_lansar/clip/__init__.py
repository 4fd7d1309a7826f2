"""CLIP: what turns pictures and commands into embeddings, and where a dataset keeps those of its pictures.

model   open_clip's towers behind one small class
store   embeddings in a folder beside a dataset's frames; needs neither torch nor LeRobot
"""
