    let limits = ltsh_tail_limits(normal, normal, view, position.w, ltsh_extent(center, half_u, half_v, area));
    if (plain > 0.0) {
        plain = ltsh_between(plain, limits.least, limits.most);
        grazing = ltsh_between(grazing, 0.0, pow(1.0 - limits.cosine, 5.0) * plain);
    }
