"""The vineyard as analytic primitives, and rays through them."""
