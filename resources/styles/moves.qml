<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable">
  <renderer-v2 type="singleSymbol" symbollevels="0" referencescale="-1" enableorderby="0" forceraster="0">
    <symbols>
      <symbol type="line" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="0,0,0,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.4" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
        <layer locked="0" class="MarkerLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="lastvertex" name="placement" />
            <Option type="QString" value="LastVertex" name="placements" />
            <Option type="QString" value="1" name="rotate" />
          </Option>
          <symbol type="marker" clip_to_extent="1" name="@0@1" force_rhr="0" alpha="1">
            <layer locked="0" class="SimpleMarker" pass="0" enabled="1">
              <Option type="Map">
                <Option type="QString" value="0" name="angle" />
                <Option type="QString" value="0,0,0,255" name="color" />
                <Option type="QString" value="1" name="horizontal_anchor_point" />
                <Option type="QString" value="filled_arrowhead" name="name" />
                <Option type="QString" value="0,0" name="offset" />
                <Option type="QString" value="no" name="outline_style" />
                <Option type="QString" value="2.6" name="size" />
                <Option type="QString" value="MM" name="size_unit" />
                <Option type="QString" value="1" name="vertical_anchor_point" />
              </Option>
            </layer>
          </symbol>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <fieldConfiguration>
    <field name="moved_m" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
  </fieldConfiguration>
  <aliases>
    <alias name="Element" field="element_id" />
    <alias name="Moved by (m)" field="moved_m" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="element_id" hidden="0" width="-1" />
      <column type="field" name="moved_m" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>1</layerGeometryType>
</qgis>
