"""Sweeps: many runs of one experiment with other values, chosen on a grid, at random or by a search.

model      what a sweep file may say
loading    the file to a `Sweep`, with located errors
search     which values are tried next: Optuna
readings   what a run is measured by
task       one run, as a worker does it
local      worker processes of this machine
cluster    the same on Ray
state      a sweep on disk: the file as resolved; its runs are the truth
trials     batches of trials, from what is recorded or by running them
results    ranking, importance, the best configuration
plots      what is drawn of a sweep
figure     the drawing
page       a sweep as one page
"""
