"""CLIP: embeddings of pictures and commands, and where a dataset stores those of its pictures.

model   open_clip's image and text encoders behind one small class
store   embeddings in a folder beside a dataset's frames; needs neither torch nor LeRobot
"""
