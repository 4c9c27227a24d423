"""Elastic supports: trellis wires and the arms of cordons, which deflect under the forces of shoots and of contacts.

``elastic_supports`` couples the shoots that hang on one wire or stand on one arm; ``deflected_wires`` represents wires
in contacts as springs; ``wire_segments`` cuts wires into segments and computes their poses for pictures and scans.
"""
