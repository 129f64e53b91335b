"""Calibrations and observations in other projects' files: what they mean here, read and written.

One module a family of formats, with its reader and its writer side by side; nothing here touches the disk but to read.
"""
