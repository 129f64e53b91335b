"""Import and export of calibrations and observations in other tools' file formats.

One module per family of formats, with its reader and its writer side by side. Writers return texts; only
readers access the disk.
"""
