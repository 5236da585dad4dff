#!/bin/sh
# Makes certificates for a studio: an authority in FOLDER if there is none, and a key and a certificate
# for each NAME, valid for a year. For tests and small studios; a large one has its own authority.
#
#   config/certificates.sh certificates node cam01 cam02 viewer
#
# NAME is the certificate's common name, which access control knows, and a DNS name. The certificates
# also hold for localhost and 127.0.0.1; ADDRESS=192.168.1.5 adds an address.
set -eu
folder=${1:?usage: certificates.sh FOLDER NAME...}
shift
umask 077
mkdir -p "$folder"
cd "$folder"
key="ec -pkeyopt ec_paramgen_curve:prime256v1"
if [ ! -e ca.pem ]; then
    openssl req -x509 -newkey $key -nodes -days 3650 -subj "/CN=bundlemocap studio" \
        -keyout ca.key.pem -out ca.pem -addext "basicConstraints=critical,CA:TRUE" 2>/dev/null
fi
for name in "$@"; do
    names="DNS:$name,DNS:localhost,IP:127.0.0.1${ADDRESS:+,IP:$ADDRESS}"
    printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth,clientAuth\n' "$names" >"$name.ext"
    openssl req -newkey $key -nodes -subj "/CN=$name" -keyout "$name.key.pem" -out "$name.csr" 2>/dev/null
    openssl x509 -req -in "$name.csr" -CA ca.pem -CAkey ca.key.pem -CAcreateserial -days 365 \
        -extfile "$name.ext" -out "$name.pem" 2>/dev/null
    rm "$name.csr" "$name.ext"
done
