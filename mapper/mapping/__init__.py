"""From solved poses to maps: fusing, levelling, planes, the cloud."""
