"""What a clip does, and how a body does it: attributes, poses in animator's terms, actions."""
