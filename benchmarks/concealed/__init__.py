"""Diagnosis on concealed effects: campaigns whose effect is drawn at random, run through the tool, scored.

``python -m benchmarks.concealed BATTERY --count N`` runs a battery and prints its table; see ``--help``.
"""
