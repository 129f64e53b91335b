"""Who may publish and subscribe: certificates, access rules, sender identity."""
