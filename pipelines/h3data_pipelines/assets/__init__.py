"""Commands about assets: `scenes`, `bodies`, `robots` and `motion`.

`scene_reports` measures and validates scenes for `scenes`; `reaching` renders the sheets of `bodies show --view reach`.
"""
