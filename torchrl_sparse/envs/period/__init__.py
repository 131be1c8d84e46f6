"""The substeps of one control step of robosuite in compiled code, bit-equal to its own Python."""
