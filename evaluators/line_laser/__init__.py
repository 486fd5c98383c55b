"""The line-laser sensor's detections and ranges against labels and rendered truth."""
