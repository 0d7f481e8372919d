"""What is computed from recordings, for commands, pages and exports alike.

In the order in which the modules build on each other:

- `sections`: the form of every answer; `contents`: what a recording has and lacks.
- `evaluations`: a run's evaluations and reports of training; `episodes`: references to episodes and steps.
- `axes`: what metrics are plotted over; `series`: the metrics of a run over an axis.
- `groups`: runs of one configuration and their curves; `compare`: `statistics` over their seeds.
- `diff`: what differs between two runs, from where on, and why.
- `histograms`, `qtable`, `summary`, `frames`: each answers one question about one run.
"""
