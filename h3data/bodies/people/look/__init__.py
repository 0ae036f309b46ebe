"""How people look: `patches` (skin, clothes and hair as meshes over the base that every body has its own shape of), `wardrobe`
(which there are), `colors` (of skin, hair and cloth), `dressing` (a dressed body)."""
