"""Frequency analysis of records: best linear approximation, noise and distortion.

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley
2012, chapters 4 and 7.
"""
