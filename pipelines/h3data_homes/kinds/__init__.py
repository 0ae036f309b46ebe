"""Models of furniture and objects of the catalogue of kinds (`h3data.scene.kinds`).

- `shapes`: the vocabulary of the model files in ``datasets/kinds/``; `parts`: solids and their triangles; `colours`
- `kind`: furniture and things made from the model of a kind
"""
