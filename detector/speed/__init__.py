"""From frames with detections to speeds of vehicles; `pipeline` describes the way."""
