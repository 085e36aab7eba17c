"""The baselines of the paper: cross-entropy method, supervised actuator net, domain randomisation, online adaptation.

They explain a mismatch by numbers alone, which is what ``diagnosis`` is measured against.
"""
