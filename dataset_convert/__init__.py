"""CALVIN demonstrations as LeRobotDatasets: `lansar-convert` or `python -m dataset_convert`.

Converting, in the order in which data flow:

convert         lansar-convert: from a CALVIN folder to a dataset in its place
options         its options
calvin          a split of the source
scenes          which scene its frames were recorded in
language        its annotated windows, and the embeddings of their sentences
frames          its frames
safe_pickle     reads .npy files from strangers, pickled ones too
episodes        which frames become an episode
plan            the episodes in shards, and everything that a worker must know of them
shared          frames of training that are in validation too
blocks          the order of the blocks, and what speaks against it
checks          what must hold of the frames: finite numbers, consistent actions
shards          converts one shard: find the bad episodes, write the others, note
writer          writes a shard's frame table and videos
look            what drew the source's pictures
poses           where the cameras are
layout          how the files lie on disk: features of cameras, paths, the manifest's name
stats           statistics of an episode, as LeRobot keeps them
features        what LeRobot is told of the dataset; the only one of these that imports LeRobot
finish          all shards become one dataset
card            its README.md
hub             uploads it, and finds downloads

On a finished dataset:

embed           lansar-embed: CLIP embeddings beside it
verify          lansar-verify: compares it with its source
verify_claims   what the dataset says of itself
verify_frames   its frames
verify_cameras  where its cameras must be
verify_shared   its frames that are in validation too
"""
