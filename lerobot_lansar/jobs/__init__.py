"""Long work, cut into shards that run here, under Slurm or on Ray; its output appears complete or not at all.

executors   runs the shards: in local processes, or through cluster
pool        local processes
cluster     Slurm and Ray, through datatrove
work        types that both share: Work, SlurmConfig, WorkerDied
staging     the hidden folder in which an output is prepared: lock, request, submitted mark, resuming
"""
