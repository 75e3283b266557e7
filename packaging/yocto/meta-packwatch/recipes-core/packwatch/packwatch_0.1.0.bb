# The vehicle's program, built from the source tree that contains this layer. To build another tree, set EXTERNALSRC.
#
# The list of crates is generated and not part of the sources. To write packwatch-crates.inc next to this file, run once, and after each
# change of Cargo.lock:
#
#   bitbake -c update_crates packwatch
#
# tests/integration/yocto_recipe.rs compares this file with the sources.
SUMMARY = "Battery health monitoring over SocketCAN, with alarms as CAN frames"
DESCRIPTION = "Estimates the state of charge of each cell, learns its capacity, and sends status, health and alarm frames \
to other ECUs."
SECTION = "base"
LICENSE = "MIT OR Apache-2.0"
LIC_FILES_CHKSUM = "file://LICENSE-MIT;md5=c4f23983d45446869c7be3f69df2656b \
                    file://LICENSE-APACHE;md5=3b83ef96387f14655fc854ddc3c6bd57"

inherit cargo cargo-update-recipe-crates externalsrc systemd

EXTERNALSRC ?= "${@os.path.realpath(d.getVar('THISDIR') + '/../../../../..')}"
# `include`, not `require`: the file is missing when the task that writes it runs for the first time.
include ${BPN}-crates.inc

# Profile and features are those of the Debian package. The program keeps its debug symbols, because bitbake moves them to
# packwatch-dbg.
CARGO_PROFILE = "vehicle"
export CARGO_PROFILE_VEHICLE_STRIP = "false"
CARGO_BUILD_FLAGS:append = " --package packwatch --no-default-features"
RUSTFLAGS:append = " --remap-path-prefix=${S}=/packwatch"

do_configure:prepend() {
    [ -e "${THISDIR}/${BPN}-crates.inc" ] || bbfatal "no list of crates, run: bitbake -c update_crates ${PN}"
}

# Uses SQLite and zstd from the crates, because the program is tested with them, not with the distribution's.
cargo_do_compile:prepend() {
    unset LIBSQLITE3_SYS_USE_PKG_CONFIG ZSTD_SYS_USE_PKG_CONFIG
}

do_install:append() {
    install -d ${D}${sysconfdir}/packwatch/cells ${D}${datadir}/packwatch/cells ${D}${systemd_system_unitdir} \
        ${D}${datadir}/packwatch/grafana ${D}${datadir}/packwatch/prometheus
    install -m 0644 ${S}/config/example.toml ${D}${sysconfdir}/packwatch/packwatch.toml
    install -m 0644 ${S}/config/pack96.dbc ${D}${sysconfdir}/packwatch/
    install -m 0644 ${S}/config/cells/example_nmc_2600.toml ${D}${sysconfdir}/packwatch/cells/
    install -m 0644 ${S}/config/packwatch.dbc ${D}${datadir}/packwatch/
    install -m 0644 ${S}/config/cells/*.toml ${D}${datadir}/packwatch/cells/
    install -m 0644 ${S}/config/grafana/packwatch.json ${D}${datadir}/packwatch/grafana/
    install -m 0644 ${S}/config/prometheus/packwatch.rules.yml ${D}${datadir}/packwatch/prometheus/
    install -m 0644 ${S}/systemd/packwatch.service ${S}/systemd/packwatch@.service ${S}/systemd/packwatch-exporter.service \
        ${D}${systemd_system_unitdir}/
}

# The service has a dynamic user. As with the Debian package, the installation enables no unit.
SYSTEMD_SERVICE:${PN} = "packwatch.service packwatch@.service packwatch-exporter.service"
SYSTEMD_AUTO_ENABLE = "disable"
CONFFILES:${PN} = "${sysconfdir}/packwatch/packwatch.toml ${sysconfdir}/packwatch/pack96.dbc ${sysconfdir}/packwatch/cells/example_nmc_2600.toml"
