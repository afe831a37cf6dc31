"""The benchmark `parity`: how far our physics differs from the reference's, and why.

campaign.py collects worlds (scenes.py makes the adversarial ones), onestep.py and episodes.py compare the engines
(engines.py), causes.py explains differences, and report.py makes tables.
"""
