"""Models of the kinds of the catalogue (`h3data.scene.kinds`).

- `shapes`: the words that the models in ``datasets/kinds/`` are written in; `parts`: solids and their triangles; `colours`
- `kind`: furniture and things made from the model of a kind
"""
