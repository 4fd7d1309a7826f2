"""CLIP: embeddings of pictures and commands, and where a dataset stores those of its pictures.

config    which CLIP: two options; needs neither torch nor open_clip
model     open_clip's image and text encoders behind one small class
commands  LeRobot's pipeline step that embeds commands
store     embeddings in a folder beside a dataset's frames; needs neither torch nor LeRobot
"""
