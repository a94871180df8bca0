"""The one judge of a stream: `limits` has the thresholds, `judge` the verdict and its sentences.

Monitor, doctor, report and node describe what they saw as an `Observation`; none of them judges by itself.
"""
