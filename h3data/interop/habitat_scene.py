def load_habitat_scene(path, scene=None):
    raise NotImplementedError
