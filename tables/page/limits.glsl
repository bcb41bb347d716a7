    /* Against bright and dark spots in the tail of the lobe: */
    ltsh_extent extent = ltsh_extent(light.center, light.half_u, light.half_v, light.area);
    ltsh_limits limits = ltsh_tail_limits(s.normal, s.normal, s.view, s.roughness, extent);
    if (integral > 0.0) {
        integral = ltsh_between(integral, limits.least, limits.most);
        grazing = ltsh_between(grazing, 0.0, pow(1.0 - limits.cosine, 5.0) * integral);
    }
