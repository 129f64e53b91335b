"""Sites: certificates, rigs as folders, bundles, systemd installation, doctor."""
