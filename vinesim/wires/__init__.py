"""Trellis wires and the arms of cordons: they give under their shoots and under what presses on them.

``elastic_supports`` couples the shoots that hang on one wire or stand on one arm; ``deflected_wires`` holds the springs
at which contacts with wires end; ``wire_segments`` cuts wires into segments and says where these are in pictures and
scans.
"""
