"""Long work: cut into shards that run here, under Slurm or on Ray, in folders that appear complete or not at all.

executors   shards in local processes, or handed over to cluster
cluster     Slurm and Ray, through datatrove
work        what executors are given: SlurmConfig, WorkerDied
staging     the hidden folder that an output is prepared in: lock, request, marks, resuming
"""
