"""The whole graph on an unseen maze: real processes over DDS, a recording, a table and a picture."""
