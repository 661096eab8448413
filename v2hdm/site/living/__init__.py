"""Changes since an earlier map: fates of its markings, looks at them, its errors, and wear."""
