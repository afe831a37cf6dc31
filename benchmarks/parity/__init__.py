"""How far our physics is from the reference's, and why.

campaign.py says where worlds come from (scenes.py has the adversarial ones), onestep.py and episodes.py compare the
engines (engines.py), causes.py explains, report.py makes tables.
"""
