"""What a worker process does with a job.

order     the job, as its worker is told; what came of it; who hears of it
seeds     a configuration: its runs, one after the other
far       the same on a cluster of Ray
sweeps    a sweep
process   the process: the pipe to the server, and how it ends
"""
